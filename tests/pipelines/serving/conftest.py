"""One weighted workspace and its server for all tests of the pages."""

from collections.abc import Iterator

import pytest
from support.serving import Pages, running, weighted_workspace

from pipelines.workspace.workspace import Workspace


@pytest.fixture(scope="session")
def weighted(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Return a workspace with weights; its folder name has characters that are special in a URI."""
    return weighted_workspace(tmp_path_factory.mktemp("a%3Fmode=rwc&b?c #d"))


@pytest.fixture(scope="module")
def pages(weighted: Workspace) -> Iterator[Pages]:
    """Return its pages, with a short time limit.

    Datasette has one set of hooks for all its servers.
    """
    pytest.importorskip("datasette", reason="the extra [serve] is not installed")
    from dataclasses import replace

    from pipelines.serving.sources import choose

    with running(replace(choose(weighted.root, None, None), time_limit_s=5), weighted) as found:
        yield found
