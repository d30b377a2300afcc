"""`semantic.reference`: computed once from X_l, stored, explained, and stale when it should be."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.rounds import run, run_workspace
from support.toys import toy_document

from curate.detections import Detections
from curate.errors import ConfigError
from curate.priors.semantic import SemanticPrior
from pipelines.assembly import open_segmenter
from pipelines.workspace.config import make_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

SEGMENTER = "support.toys:ToyImageSegmenter"


def rows(workspace: Workspace, sql: str) -> list[dict[str, Any]]:
    """Return the rows of a query, by column name."""
    with workspace.database.reading() as connection:
        return [dict(row) for row in connection.exec_driver_sql(sql).mappings()]


def calls(workspace: Workspace) -> list[str]:
    """Return the frames that the segmenter has seen, in order; then forget them."""
    path = workspace.config.segmenter.path.with_name("segmented.txt")
    seen = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return seen


@pytest.fixture
def plain(workspace: Workspace) -> Workspace:
    """Return a workspace with stored maps and without references."""
    return workspace.with_settings("segmenter", name=SEGMENTER)


def relative(workspace: Workspace, **changes: Any) -> Workspace:
    """Return the workspace with references."""
    found = workspace.with_settings("semantic", reference=True, **changes)
    write_config(found.root / "curate.toml", found.with_settings("segmenter", cache=None).config)
    return found


def by_hand(workspace: Workspace) -> dict[str, float]:
    """Return the upper quartiles of S/A over the labeled boxes in the image."""
    prior = SemanticPrior(open_segmenter(workspace.config))
    shares: dict[str, list[float]] = {}
    for name, truth in workspace.ground_truth("labeled").items():
        labels = Detections(truth.boxes, np.ones(len(truth)), truth.categories)
        measured = prior.measure(workspace.dataset.read(name, image=True), labels)
        for category, *counts in zip(truth.categories, *measured.values(), strict=True):
            if counts[1]:
                shares.setdefault(str(category), []).append(counts[0] / counts[1])
    return {category: float(np.quantile(found, 0.75)) for category, found in shares.items()}


def test_references_are_stored_applied_and_explained(plain: Workspace, curate: Curate) -> None:
    """In the view, an export's labels, and the arithmetic of explain, which works it out again."""
    run(plain)
    before = {
        (row["frame"], row["k"]): row
        for row in rows(plain, "SELECT * FROM weighted_labels ORDER BY frame, k")
    }
    assert "share_reference" not in next(iter(before.values()))
    own = relative(plain)
    done = run(own)
    assert (done["predict"], done["points"]) == (0, 0)
    assert (done["semantic"], done["solve"]) == (6, 1)
    quartiles = by_hand(own)
    stored = rows(own, "SELECT category, boxes, upper_quartile FROM semantic_reference")
    assert {row["category"]: row["upper_quartile"] for row in stored} == pytest.approx(quartiles)
    found = rows(own, "SELECT * FROM weighted_labels ORDER BY frame, k")
    assert list(found[0])[-2:] == ["weight", "share_reference"]
    for row in found:
        assert row["share_reference"] == pytest.approx(quartiles[row["category"]])
        if row["box_pixels"]:
            share = row["mask_pixels"] / row["box_pixels"] / row["share_reference"]
            assert row["rho_anno"] == pytest.approx(np.sqrt(row["score"] * min(1, share)))
        assert row["rho_anno"] >= before[row["frame"], row["k"]]["rho_anno"]
    label = next(row for row in found if row["box_pixels"])
    code, out, err = curate("explain", label["frame"], str(label["k"]), "-w", own.root)
    assert code == 0, err
    assert f"/ {label['share_reference']:.4f}) = " in out
    assert "they differ" not in out


def test_references_are_computed_once(plain: Workspace) -> None:
    """Maps of labeled frames are made once; only a change of what they depend on counts.

    Switching off and on again restores the labels without segmenting anything.
    """
    own = relative(plain)
    reports = run_workspace(own)
    maps = [(each.stage, each.done) for each in reports if each.stage.startswith("segment")]
    assert maps == [("segment labeled", 2), ("segment", 6)]
    assert len(calls(own)) == 2 + 6
    labels = rows(own, "SELECT * FROM weighted_labels ORDER BY frame, k")
    assert set(run(own).values()) == {0}
    product = relative(plain, mean="product")
    assert run(product)["semantic"] == 6
    for each in (plain, own):
        assert run(each)["semantic"] == 6
    assert calls(own) == []
    assert rows(own, "SELECT * FROM weighted_labels ORDER BY frame, k") == labels
    reused = rows(own, "SELECT fingerprint FROM semantic_reference")
    changed = own.with_settings("segmenter", options={"bright": 100})
    assert run(changed)["semantic"] == 6
    assert len(calls(own)) == 2 + 6
    assert rows(own, "SELECT fingerprint FROM semantic_reference") != reused


def test_a_category_outside_every_labeled_image_is_left_as_it_is(
    plain: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    """One line; its labels have no reference, those of others have one."""
    with plain.database.writing() as connection:
        connection.exec_driver_sql("UPDATE ground_truth SET x = -x WHERE category = 'Cyclist'")
    run(relative(plain))
    [line] = [each for each in caplog.messages if "semantic.reference" in each]
    assert "no labeled box of Cyclist is inside an image" in line
    found = rows(plain, "SELECT category, share_reference FROM weighted_labels")
    assert all((row["share_reference"] is None) is (row["category"] == "Cyclist") for row in found)


def test_without_labeled_frames_the_setting_is_rejected(
    tmp_path: Path,
    toy_kitti: Path,
    weights_file: Path,
    new_url: Callable[[], str | None],
    curate: Curate,
) -> None:
    """At init, and before any work by each command and by doctor, in one line."""
    document = toy_document(toy_kitti, weights_file) | {"run": {"database": new_url()}}
    config = make_config(document | {"semantic": {"reference": True}}, "test")
    with pytest.raises(ConfigError, match=r"semantic\.reference = true .* no labeled frames"):
        initialise(tmp_path / "refused", config, "0", "")
    workspace = initialise(tmp_path / "work", make_config(document, "test"), "0", "")
    write_config(workspace.root / "curate.toml", config)
    for command in (("run",), ("score", "--prior", "semantic")):
        code, out, err = curate(*command, "-w", workspace.root)
        assert code == ConfigError.exit_code, out
        assert "there are no labeled frames; label some, or set semantic.reference" in err
        assert err.count("\n") == 1
    code, out, _ = curate("doctor", "--json", "-w", workspace.root)
    assert "there are no labeled frames" in json.dumps(json.loads(out))
    assert rows(workspace, "SELECT * FROM prediction") == []
