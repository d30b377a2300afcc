"""The settings that the cells of a bench share: reading, merging, checking, storing."""

from pathlib import Path

import pytest
from support.bench_results import make_bench

from curate.errors import ConfigError, DataError, WorkspaceError
from pipelines.bench.settings import Axes, Bench, BenchSettings, check_axes, claim, read_bench
from pipelines.stages.methods import with_method

AXES = Axes(methods=("baseline",), ratios=(0.5,), seeds=(0,))


def bench_with(toy_kitti: Path, tmp_path: Path, *overrides: str) -> Bench:
    """Return a bench with some overrides."""
    return Bench(tmp_path, BenchSettings(data=str(toy_kitti), overrides=overrides), AXES)


def test_overrides_reach_the_configuration_of_every_method(toy_kitti: Path, tmp_path: Path) -> None:
    """Numbers, words, lists and tables of options, each in TOML's notation or as a bare word."""
    bench = bench_with(
        toy_kitti,
        tmp_path,
        "train.zero_weight=background",
        "points.quantile=0.25",
        'run.priors=["points"]',
        "solve.options.threshold.threshold=0.4",
    )
    for method in ("baseline", "pspsl"):
        config = bench.config(3, method)
        assert config.train.zero_weight == "background"
        assert config.points.quantile == 0.25
        assert config.run.priors == ("points",)
        assert config.solve.options == {"threshold": {"threshold": 0.4}}
        assert config.run.seed == 3
        assert config == with_method(config, method)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.zero_wight=ignore", "train.zero_wight"),
        ("train.zero_weight=nothing", "train.zero_weight"),
        ("run.seed=3", "cannot be set for a bench; use --seeds"),
        ("train.round_steps=3", "cannot be set for a bench; use --steps"),
        ("zero_weight=ignore", "section.key=value"),
        ("train.zero_weight", "section.key=value"),
        ("detector.name=recorded", "needs a detector that it can train"),
    ],
)
def test_wrong_overrides_are_rejected(
    toy_kitti: Path, tmp_path: Path, override: str, message: str
) -> None:
    """The configuration's model checks them.

    Keys that the grid sets itself cannot be overridden.
    """
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        bench_with(toy_kitti, tmp_path, override).config(0, "baseline")


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"methods": ("pspsll",)}, "--methods pspsll: unknown method; choose from baseline"),
        ({"methods": ()}, "--methods : give one or more values"),
        ({"ratios": (0.5, 0.5)}, "--ratios 0.5,0.5: give one or more values without duplicates"),
        ({"ratios": (4.0,)}, "--ratios 4: must be above 0"),
        ({"seeds": (-1,)}, "--seeds -1"),
    ],
)
def test_wrong_axes_are_rejected(axes: dict, message: str) -> None:
    """The one-line error contains the option."""
    with pytest.raises(ConfigError, match=message):
        check_axes(AXES.model_copy(update=axes))


def test_the_stored_settings_of_a_bench_are_read_back(toy_kitti: Path, tmp_path: Path) -> None:
    """A folder without settings has none."""
    assert read_bench(tmp_path) is None
    bench = make_bench(tmp_path, toy_kitti, overrides=("train.batch_size=4",))
    assert read_bench(tmp_path) == bench


def test_a_grid_can_grow_but_its_settings_cannot_change(toy_kitti: Path, tmp_path: Path) -> None:
    """More seeds are allowed; with other steps the cells could not be compared."""
    make_bench(tmp_path, toy_kitti)
    make_bench(tmp_path, toy_kitti, seeds=(0, 1))
    with pytest.raises(WorkspaceError, match=r"steps 4 instead of 5; .* another folder"):
        make_bench(tmp_path, toy_kitti, steps=5)
    found = read_bench(tmp_path)
    assert found is not None
    assert (found.settings.steps, found.axes.seeds) == (4, (0, 1))


def test_damaged_settings_are_reported(toy_kitti: Path, tmp_path: Path) -> None:
    """The error contains the file."""
    claim(make_bench(tmp_path, toy_kitti))
    (tmp_path / "bench.json").write_text('{"settings": {"steps": 0}}')
    with pytest.raises(DataError, match=r"bench\.json: is damaged"):
        read_bench(tmp_path)
