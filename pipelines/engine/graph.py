"""The graph of a round. A stage depends on the stages that write the tables it reads."""

from collections.abc import Iterator
from dataclasses import dataclass

from curate.errors import ConfigError
from pipelines.engine.stage import CacheStage, FirstStage, FramesStage, RoundStage, Stage


@dataclass(frozen=True)
class Graph:
    """The stages of a workspace in topological order.

    Attributes:
        stages: all stages; those before the first round come first.
    """

    stages: tuple[Stage, ...]

    def stage(self, name: str) -> Stage:
        """Return the stage with this name.

        Raises:
            ConfigError: if there is no such stage.
        """
        for stage in self.stages:
            if stage.name == name:
                return stage
        names = ", ".join(stage.name for stage in self.stages)
        raise ConfigError(f"unknown stage '{name}': use one of {names}")

    def frames_stage(self, name: str) -> FramesStage:
        """Return the stage with this name, which has to be a stage of frames.

        Raises:
            ConfigError: if there is no such stage, or its rows do not belong to frames.
        """
        stage = self.stage(name)
        if not isinstance(stage, FramesStage):
            raise ConfigError(f"stage '{name}' does not run per frame")
        return stage

    def round_stage(self, name: str) -> RoundStage:
        """Return the stage with this name, which has to run once per round and policy.

        Raises:
            ConfigError: if there is no such stage, or it does not run once per round.
        """
        stage = self.stage(name)
        if not isinstance(stage, RoundStage):
            raise ConfigError(f"stage '{name}' does not run once per round")
        return stage

    @property
    def first_stages(self) -> Iterator[FirstStage]:
        """The stages that run once, before the first round."""
        return (stage for stage in self.stages if isinstance(stage, FirstStage))

    @property
    def frames_stages(self) -> Iterator[FramesStage]:
        """The stages with rows that belong to frames."""
        return (stage for stage in self.stages if isinstance(stage, FramesStage))

    def before(self, stage: Stage) -> tuple[FramesStage, ...]:
        """Return the stages of frames that a stage depends on, directly or through others."""
        needed = set(stage.reads)
        found: list[FramesStage] = []
        for other in reversed(self.stages[: self.stages.index(stage)]):
            if needed & set(other.results):
                needed |= set(other.reads)
                if isinstance(other, FramesStage):
                    found.insert(0, other)
        return tuple(found)

    @property
    def cache_stages(self) -> Iterator[CacheStage]:
        """The stages that make ahead what later stages would make themselves."""
        return (stage for stage in self.stages if isinstance(stage, CacheStage))

    def readers(self, stage: CacheStage) -> tuple[FramesStage, ...]:
        """Return the stages of frames that read what a cache stage writes."""
        written = set(stage.writes)
        return tuple(other for other in self.frames_stages if written & set(other.reads))

    def as_mermaid(self) -> str:
        """Return a Mermaid flowchart of tables (rounded) and stages (boxes)."""
        lines = ["flowchart LR"]
        for stage in self.stages:
            node = stage.name.replace("-", "_")
            lines.append(f"    {node}[{stage.name}]")
            lines += [f"    {_node(name)}({name}) --> {node}" for name in stage.reads]
            lines += [f"    {node} --> {_node(name)}({name})" for name in stage.writes]
        return "\n".join(lines)


def _node(table: str) -> str:
    return "t_" + table.replace(".", "_")
