"""`curate serve`: every table, query and frame has its page."""

import json
import sqlite3

import cv2
import numpy as np
import pytest
from support.serving import Pages

from db.models import Base
from pipelines.labels.by_frame import chosen_round
from pipelines.queries.named_queries import named_queries
from pipelines.queries.run_query import run_query
from pipelines.reports.pictures import frame_picture

pytest.importorskip("datasette", reason="the extra [serve] is not installed")


def test_the_first_page_links_to_both_databases(pages: Pages) -> None:
    """It lists the queries with their descriptions."""
    response = pages.get("/")
    assert response.status == 200
    assert 'href="/workspace"' in response.text
    assert 'href="/labels"' in response.text
    assert all(query.description.split("`")[0][:30] in response.text.replace("&#39;", "'")
               for query in named_queries().values())  # fmt: skip


@pytest.mark.parametrize("name", sorted(Base.metadata.tables))
def test_a_table_shows_its_description(pages: Pages, name: str) -> None:
    """The text comes from its model."""
    response = pages.get(f"/workspace/{name}")
    assert response.status == 200
    assert "metadata-description" in response.text


@pytest.mark.parametrize("name", named_queries())
def test_a_named_query_gives_the_same_rows_as_curate_query(pages: Pages, name: str) -> None:
    """The same columns, too; those of the working database only there."""
    query = named_queries()[name]
    columns, rows = run_query(pages.workspace.database.url, query.sql)
    response = json.loads(pages.get(f"/workspace/{name}.json", _shape="array").text)
    assert len(response) == len(list(rows))
    assert all(list(row) == list(columns) for row in response)
    assert pages.get(f"/workspace/{name}").status == 200
    assert pages.get(f"/labels/{name}").status == (200 if query.exported else 404)


def test_a_label_links_to_its_frame(pages: Pages) -> None:
    """From its row, with round and policy; the number of the label links to its explanation."""
    text = pages.get("/labels/weighted_labels").text
    name = next(iter(pages.workspace.frames("unlabeled")))
    link = f"/-/frame?frame={name}&amp;round=1&amp;policy=pspsl"
    assert link in text
    assert f"{link}&amp;k=0" in text
    assert "/-/frame?id=" in pages.get("/workspace/weight").text
    page = pages.get(link.replace("&amp;", "&") + "&k=0")
    assert page.status == 200
    assert "recomputed" in page.text


def test_an_image_is_the_one_of_curate_view(pages: Pages) -> None:
    """Nearly equal, because it is sent as JPEG."""
    response = pages.get("/-/picture", frame="000003")
    assert (response.status, response.headers["content-type"]) == (200, "image/jpeg")
    shown = cv2.imdecode(np.frombuffer(response.body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    drawn = frame_picture(pages.workspace, "000003", chosen_round(pages.workspace, None), "pspsl")
    assert shown.shape == drawn.shape
    assert np.abs(shown.astype(int) - drawn).mean() < 6
    assert list((pages.workspace.root / "pictures").iterdir()) == []


@pytest.mark.parametrize("split", ["labeled", "unlabeled", "val"])
def test_every_split_has_pages(pages: Pages, split: str) -> None:
    """Neighbours are of the same split; name and key lead to the same frame."""
    names = pages.workspace.frames(split)
    first, second = list(names)[:2]
    response = pages.get("/-/frame", frame=first)
    assert response.status == 200
    assert f"frame={second}&amp;" in response.text
    assert response.body == pages.get("/-/frame", id=names[first]).body


def test_a_new_export_is_served_without_a_restart(pages: Pages) -> None:
    """The file has been replaced, not changed."""
    path = pages.workspace.root / "exports" / "labels.sqlite"
    before = pages.get("/labels.json", sql="SELECT count(*) FROM label", _shape="arrayfirst").text
    held = path.read_bytes()
    other = path.with_name("other.sqlite")
    other.write_bytes(held)
    with sqlite3.connect(other) as connection:
        connection.execute("DELETE FROM label WHERE k > 0")
    connection.close()
    other.replace(path)
    after = pages.get("/labels.json", sql="SELECT count(*) FROM label", _shape="arrayfirst").text
    path.write_bytes(held)
    assert json.loads(after)[0] < json.loads(before)[0]
