"""The graph of a round: its stages in order; a stage depends on those that write what it reads."""

from collections.abc import Iterator
from dataclasses import dataclass

from curate.errors import ConfigError
from pipelines.engine.stage import FirstStage, FramesStage, RoundStage, Stage


@dataclass(frozen=True)
class Graph:
    """The stages of a workspace, in an order in which each comes after those that it depends on.

    Attributes:
        stages: all of them; those before the first round come first.
    """

    stages: tuple[Stage, ...]

    def stage(self, name: str) -> Stage:
        """Return the stage of that name.

        Raises:
            ConfigError: if there is no such stage.
        """
        for stage in self.stages:
            if stage.name == name:
                return stage
        known = ", ".join(stage.name for stage in self.stages)
        raise ConfigError(f"unknown stage '{name}': use one of {known}")

    def of_frames(self, name: str) -> FramesStage:
        """Return the stage of that name, whose rows belong to frames.

        Raises:
            ConfigError: if there is no such stage of frames.
        """
        stage = self.stage(name)
        if not isinstance(stage, FramesStage):
            raise ConfigError(f"stage '{name}' is not done per frame")
        return stage

    def of_rounds(self, name: str) -> RoundStage:
        """Return the stage of that name, which is done once per round and policy.

        Raises:
            ConfigError: if there is no such stage of rounds.
        """
        stage = self.stage(name)
        if not isinstance(stage, RoundStage):
            raise ConfigError(f"stage '{name}' is not done once per round")
        return stage

    @property
    def first_stages(self) -> Iterator[FirstStage]:
        """The stages that are done once, before the first round."""
        return (stage for stage in self.stages if isinstance(stage, FirstStage))

    @property
    def frames_stages(self) -> Iterator[FramesStage]:
        """The stages whose rows belong to frames."""
        return (stage for stage in self.stages if isinstance(stage, FramesStage))

    def before(self, stage: Stage) -> tuple[FramesStage, ...]:
        """Return the stages of frames whose rows a stage needs, directly or through others."""
        needed = set(stage.reads)
        found: list[FramesStage] = []
        for other in reversed(self.stages[: self.stages.index(stage)]):
            if needed & set(other.writes):
                needed |= set(other.reads)
                if isinstance(other, FramesStage):
                    found.insert(0, other)
        return tuple(found)

    def as_mermaid(self) -> str:
        """Return a flowchart of tables (rounded) and stages (boxes)."""
        lines = ["flowchart LR"]
        for stage in self.stages:
            node = stage.name.replace("-", "_")
            lines.append(f"    {node}[{stage.name}]")
            lines += [f"    {_node(name)}({name}) --> {node}" for name in stage.reads]
            lines += [f"    {node} --> {_node(name)}({name})" for name in stage.writes]
        return "\n".join(lines)


def _node(table: str) -> str:
    return "t_" + table.replace(".", "_")
