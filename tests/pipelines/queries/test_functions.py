"""SQL functions: values against numpy and the geometry, nulls, and errors."""

import json
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from curate.geometry.overlap import bev_iou
from pipelines.queries import functions
from pipelines.queries.functions import FUNCTIONS, register_functions
from pipelines.serving.read_only import connect_read_only
from pipelines.workspace.workspace import Workspace

RNG = np.random.default_rng(7)
X, Y = RNG.normal(1e6, 3, 501), RNG.uniform(-2, 5, 501)
Y += (X - 1e6) / 2


@pytest.fixture
def connection() -> Iterator[sqlite3.Connection]:
    """Return a connection with values x and y, a null in each, and group 1 of a single row."""
    with closing(sqlite3.connect(":memory:")) as opened:
        register_functions(opened)
        opened.execute("CREATE TABLE t (g INTEGER, x REAL, y REAL)")
        rows = [(0, float(x), float(y)) for x, y in zip(X, Y, strict=True)]
        rows += [(0, None, None), (1, 3.0, 4.0), (1, None, 7.0)]
        opened.executemany("INSERT INTO t VALUES (?, ?, ?)", rows)
        yield opened


@pytest.mark.parametrize(
    ("sql", "expected"),
    [
        ("median(x)", np.median(X)),
        ("median(CAST(x AS INTEGER))", np.median(X.astype(int))),
        ("quantile(x, 0)", X.min()),
        ("quantile(x, 0.05)", np.quantile(X, 0.05)),
        ("quantile(x, 0.9)", np.quantile(X, 0.9)),
        ("quantile(x, 1)", X.max()),
        ("stddev(x)", np.std(X, ddof=1)),
        ("stddev(y)", np.std(Y, ddof=1)),
        ("corr(x, y)", np.corrcoef(X, Y)[0, 1]),
        ("corr(x, -x)", -1.0),
    ],
)
def test_the_values_equal_those_of_numpy(
    connection: sqlite3.Connection, sql: str, expected: float
) -> None:
    """Nulls do not count."""
    [(value,)] = connection.execute(f"SELECT {sql} FROM t WHERE g = 0")
    assert value == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("sql", ["median(x)", "quantile(x, 0.5)", "stddev(x)", "corr(x, y)"])
def test_without_values_the_result_is_null(connection: sqlite3.Connection, sql: str) -> None:
    """A group without rows, or with nulls only; a single value has no deviation."""
    assert connection.execute(f"SELECT {sql} FROM t WHERE g = 2").fetchone() == (None,)
    assert connection.execute(f"SELECT {sql} FROM t WHERE x IS NULL").fetchone() == (None,)
    alone = connection.execute(f"SELECT {sql} FROM t WHERE g = 1").fetchone()[0]
    assert alone == (3.0 if sql[0] in "mq" else None)


def test_groups_are_kept_separate(connection: sqlite3.Connection) -> None:
    rows = connection.execute("SELECT g, median(x) FROM t GROUP BY g ORDER BY g").fetchall()
    assert rows == [(0, pytest.approx(np.median(X))), (1, 3.0)]


def test_constant_values_have_no_correlation(connection: sqlite3.Connection) -> None:
    """As on PostgreSQL."""
    assert connection.execute("SELECT corr(x, 1) FROM t").fetchone() == (None,)


def test_overlaps_equal_those_of_the_geometry(connection: sqlite3.Connection) -> None:
    """Of boxes that overlap partly, wholly and not at all; a null box has none."""
    for _ in range(50):
        a, b = RNG.uniform([-2, -2, 1, 1, -4], [2, 2, 5, 3, 4], (2, 5))
        boxes = [[x, y, 0.0, length, width, 1.5, yaw] for x, y, length, width, yaw in (a, b)]
        expected = bev_iou(np.array(boxes[:1]), np.array(boxes[1:]))[0, 0]
        sql = f"SELECT iou_bev({', '.join('?' * 10)})"
        [(value,)] = connection.execute(sql, (*map(float, a), *map(float, b)))
        assert value == pytest.approx(expected, abs=1e-12)
    box = "0, 0, 4, 2, 0.3"
    assert connection.execute(f"SELECT iou_bev({box}, {box})").fetchone() == (1.0,)
    assert connection.execute(f"SELECT iou_bev({box}, 9, 9, 4, 2, 0)").fetchone() == (0.0,)
    assert connection.execute(f"SELECT iou_bev({box}, 0, 0, 4, 2, NULL)").fetchone() == (None,)


@pytest.mark.parametrize(
    ("sql", "word"),
    [
        ("SELECT quantile(weight, 1.5) FROM weighted_labels", "q is 1.5, but must be between"),
        ("SELECT quantile(weight, weight / 2) FROM weighted_labels", "the same in all rows"),
        ("SELECT median(frame) FROM weighted_labels", "median: '00000"),
        ("SELECT stddev(category) FROM weighted_labels", "is not a number"),
        ("SELECT corr(weight, category) FROM weighted_labels", "is not a number"),
        ("SELECT iou_bev('a', 0, 1, 1, 0, 0, 0, 1, 1, 0)", "iou_bev: 'a' is not a number"),
        ("SELECT median(1, 2)", "wrong number of arguments"),
    ],
)
def test_a_wrong_argument_gives_a_one_line_error(
    curate: Curate, workspace: Workspace, sql: str, word: str
) -> None:
    """Whether the function or SQLite finds it."""
    assert curate("run", "-w", workspace.root)[0] == 0
    code, _, err = curate("query", sql, "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert word in err
    assert err.count("\n") == 1


def test_a_median_holds_a_bounded_number_of_values(
    connection: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise an endless query would fill the memory."""
    monkeypatch.setattr(functions, "MOST_VALUES", 500)
    assert connection.execute("SELECT median(x) FROM t").fetchone() == (None,)
    assert connection.execute("SELECT median(x) FROM t WHERE g = 1").fetchone() == (3.0,)


def test_a_workspace_and_a_served_file_have_all_functions(
    curate: Curate, workspace: Workspace
) -> None:
    """With the documented number of arguments."""
    boxes = "0, 0, 4, 2, 0, 1, 0, 4, 2, 0"
    columns = ["median(k)", "quantile(k, 0.5)", "corr(k, k)", "stddev(k)", f"iou_bev({boxes})"]
    assert [each.split("(")[0] for each in columns] == [each.name for each in FUNCTIONS]
    sql = f"SELECT {', '.join(columns)} FROM (SELECT 1 AS k UNION SELECT 2 UNION SELECT 6)"
    [row] = json.loads(curate("query", sql, "--json", "-w", workspace.root)[1])
    expected = [2.0, 2.0, 1.0, np.std([1, 2, 6], ddof=1), 0.6]
    assert list(row.values()) == pytest.approx(expected)
    with closing(connect_read_only(workspace.root / "curate.db")) as served:
        assert served.execute(sql).fetchone() == pytest.approx(expected)


def test_a_connection_imports_nothing_heavy() -> None:
    """Neither numba nor torch nor numpy, until a function needs it."""
    code = (
        "import sqlite3, sys\n"
        "from pipelines.queries.functions import register_functions\n"
        "opened = sqlite3.connect(':memory:')\n"
        "register_functions(opened)\n"
        "opened.execute('SELECT stddev(1), corr(1, 2)').fetchone()\n"
        "assert not {'numba', 'torch', 'numpy'} & set(sys.modules), sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
