"""`curate serve` under attack: nothing is written, no other file is read."""

import hashlib
import sqlite3
from pathlib import Path

import pytest
from support.serving import Pages

pytest.importorskip("datasette", reason="the extra [serve] is not installed")

from pipelines.serving.guard import is_loopback
from pipelines.serving.read_only import connect_read_only

WRITES = (
    "INSERT INTO weight SELECT * FROM weight",
    "UPDATE weight SET v = 1",
    "DELETE FROM weight",
    "DROP TABLE weight",
    "CREATE TABLE t (a)",
    "CREATE TEMP TABLE t (a)",
    "CREATE TRIGGER t AFTER INSERT ON weight BEGIN SELECT 1; END",
    "ALTER TABLE weight ADD COLUMN a",
    "WITH a AS (SELECT 1) DELETE FROM weight",
    "REINDEX",
    "ANALYZE",
    "VACUUM",
    "VACUUM INTO 'stolen.db'",
    "ATTACH DATABASE 'stolen.db' AS other",
    "ATTACH '/etc/passwd' AS other",
    "DETACH main",
    "PRAGMA query_only = OFF",
    "PRAGMA journal_mode = DELETE",
    "PRAGMA writable_schema = ON",
    "PRAGMA schema_version = 1",
    "PRAGMA temp_store_directory = '/tmp'",
    "PRAGMA wal_checkpoint(TRUNCATE)",
    "BEGIN IMMEDIATE",
    "SAVEPOINT s",
)
READS_ELSEWHERE = (
    "SELECT load_extension('libc.so.6')",
    "SELECT readfile('/etc/passwd')",
    "SELECT writefile('stolen', 'x')",
    "SELECT edit('x', 'touch stolen')",
    "SELECT fts3_tokenizer('simple')",
    "SELECT * FROM pragma_database_list",
    "SELECT * FROM pragma_compile_options",
    "SELECT * FROM sqlite_dbpage",
    "SELECT * FROM dbstat",
    "SELECT * FROM json_each('[1]')",
)
TOO_MUCH = (
    "SELECT zeroblob(1000000000)",
    "SELECT hex(zeroblob(20000))",
    "SELECT printf('%.*c', 1000000000, 'x')",
    "SELECT FORMAT('%1000000000d', 1)",
    "SELECT replace(hex(zeroblob(10000)), '0', '00000000')",
    f"SELECT {', '.join(['zeroblob(29999)'] * 101)}",
    "SELECT group_concat(hex(zeroblob(10000))) FROM frame",
    f"SELECT 1 WHERE 'a' LIKE '{'%a' * 200}'",
    "SELECT 1" + " UNION ALL SELECT 1" * 50,
    "SELECT " + "(" * 300 + "1" + ")" * 300,
)
ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n",
    f"SELECT count(*) FROM {', '.join(f'frame f{i}' for i in range(16))}",
)
NO_FRAMES = (
    "../../../../etc/passwd",
    "/etc/passwd",
    "..%2f..%2fetc%2fpasswd",
    "000003/../000003",
    "000003.png",
    "000003\x00",
    "file:///etc/passwd",
    "' OR 1=1 --",
    "<script>alert(1)</script>",
    "a" * 5000,
    "",
)
NO_PATHS = (
    "/-/static/../../../../../../../../etc/passwd",
    "/-/static/..%2f..%2f..%2f..%2f..%2fetc%2fpasswd",
    "/-/static//etc/passwd",
    "/-/static-plugins/pipelines.serving/../plugin.py",
    "/-/static-plugins/pipelines.serving/..%2fplugin.py",
    "/-/static-plugins/pipelines.serving//etc/passwd",
    "/-/../curate.db",
    "/curate.db",
    "/workspace.db",
    "/labels.db",
    "/..%2fcurate.toml",
    "/-/databases.json",
    "/-/versions.json",
    "/-/plugins.json",
    "/-/settings.json",
    "/-/threads.json",
    "/-/metadata.json",
    "/-/permissions",
    "/-/allow-debug",
    "/-/messages",
    "/-/auth-token?token=1",
    "//-/databases.json",
    "//evil.example/",
    "/%2d/databases.json",
    "/-%2fdatabases.json",
    "/./-/databases.json",
    "/_internal",
    "/_internal.json?sql=select+*+from+databases",
    "/%5finternal",
    "/_memory?sql=select+1",
)


@pytest.fixture
def connection(pages: Pages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return the connection on which queries run, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    opened = connect_read_only(pages.workspace.root / "curate.db")
    yield opened
    opened.close()


def content(pages: Pages) -> str:
    """Return a hash of the workspace, without SQLite's shared memory and empty journal."""
    digest = hashlib.sha256()
    for path in sorted(pages.workspace.root.rglob("*")):
        if path.is_file() and path.stat().st_size and not path.name.endswith("-shm"):
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


@pytest.mark.parametrize("sql", [*WRITES, *READS_ELSEWHERE, *TOO_MUCH])
def test_a_connection_is_read_only(
    connection: sqlite3.Connection, tmp_path: Path, sql: str
) -> None:
    """Also if there is no file yet; none is created."""
    with pytest.raises((sqlite3.Error, sqlite3.Warning, MemoryError)):
        connection.execute(sql).fetchall()
    assert list(tmp_path.iterdir()) == []
    assert connection.execute("SELECT count(*) FROM weight").fetchone()[0] > 0


def test_sql_that_writes_is_rejected_in_one_line(pages: Pages) -> None:
    """Some of each kind, as page and as JSON; no file of the workspace changes."""
    before = content(pages)
    for sql in (*WRITES[::6], *READS_ELSEWHERE[::4], *TOO_MUCH[::4]):
        response = pages.get("/workspace.json", sql=sql)
        assert response.status == 400, sql
        assert b"Traceback" not in response.body
    assert pages.get("/labels", sql=WRITES[0]).status == 400
    where = "1 = 1; DELETE FROM weight"
    assert pages.get("/workspace/weight.json", _where=where).status == 400
    assert content(pages) == before


@pytest.mark.parametrize("sql", ENDLESS)
def test_an_endless_query_is_stopped(pages: Pages, sql: str) -> None:
    """The error says what to do; the server keeps running."""
    response = pages.get("/workspace", sql=sql)
    assert response.status == 400
    assert "--time-limit" in response.text
    assert pages.get("/").status == 200


@pytest.mark.parametrize("name", NO_FRAMES)
def test_a_frame_name_is_not_used_as_a_path(pages: Pages, name: str) -> None:
    """In any position of the URL."""
    for parameters in (
        {"frame": name},
        {"frame": "000003", "policy": name or "x"},
        {"frame": "000003", "round": name or "-1"},
        {"id": name},
    ):
        response = pages.get("/-/picture", **parameters)
        assert response.status == 404, parameters
        assert b"root:" not in response.body
    assert b"<script>alert" not in pages.get("/-/frame", frame=name, k=name).body


@pytest.mark.parametrize("path", NO_PATHS)
def test_no_other_file_or_internal_page_can_be_reached(pages: Pages, path: str) -> None:
    """The path is sent as written here; a browser would normalise it."""
    response = pages.get(path)
    assert response.status in {302, 400, 403, 404}, path
    if response.status == 302:
        response = pages.get(response.headers["location"])
        assert response.status in {400, 403, 404}, path
    for secret in (b"root:", b"SQLite format 3", b"hookimpl", b"[dataset]", b'"path"'):
        assert secret not in response.body


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"])
def test_only_reading_methods_are_allowed(pages: Pages, method: str) -> None:
    """For every page."""
    for path in ("/", "/workspace", "/workspace/age", "/-/frame?frame=000003"):
        assert pages.get(path, method=method, body="a=1").status == 405


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8001", "", "[::2]"]
)
def test_an_unknown_host_name_is_rejected(pages: Pages, host: str) -> None:
    """A host name that points to this machine cannot read anything (DNS rebinding)."""
    assert pages.get("/labels/weighted_labels.json", headers={"Host": host}).status == 403
    assert pages.get("/", headers={"Host": f"localhost:{pages.port}"}).status == 200


def test_another_site_can_only_link_to_a_page(pages: Pages) -> None:
    """Its requests for images, frames and scripts are rejected; a followed link works."""
    for kind in ("image", "iframe", "script", "empty"):
        headers = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": kind}
        assert pages.get("/-/picture?frame=000003", headers=headers).status == 403
    headers = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
    assert pages.get("/", headers=headers).status == 200


def test_every_response_restricts_what_a_browser_loads(pages: Pages) -> None:
    """Rejections too; no other site is allowed."""
    for path in ("/", "/nowhere", "/-/databases", "/-/picture?frame=000003", "/-/static/app.css"):
        headers = pages.get(path).headers
        assert headers["content-security-policy"].startswith("default-src 'none'")
        assert "http" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


def test_many_parallel_requests_are_all_answered(pages: Pages) -> None:
    """Images are drawn one at a time, and each request gets its own."""
    from concurrent.futures import ThreadPoolExecutor

    names = list(pages.workspace.frames("unlabeled"))[:3] * 4
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda name: pages.get("/-/picture", frame=name).body, names))
    assert len({(name, body) for name, body in zip(names, found, strict=True)}) == 3


def test_installed_plugins_are_not_loaded(pages: Pages) -> None:
    """Some of them write."""
    from datasette.plugins import pm

    assert pm.list_plugin_distinfo() == []


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("localhost", True), ("127.0.0.1", True), ("127.8.8.8", True), ("::1", True),
     ("0.0.0.0", False), ("::", False), ("192.168.1.2", False), ("lab.example", False)],  # noqa: S104
)  # fmt: skip
def test_loopback_is_recognised(host: str, loopback: bool) -> None:
    """By name and by address."""
    assert is_loopback(host) == loopback
