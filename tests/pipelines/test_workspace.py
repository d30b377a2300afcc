"""A workspace with settings of one command."""

import pytest

from curate.errors import ConfigError
from pipelines.workspace import Workspace


def test_settings_of_a_command_change_their_section_alone(workspace: Workspace) -> None:
    """The other sections are the very same objects."""
    changed = workspace.with_settings("run", workers=3)
    assert changed.config.run == workspace.config.run.model_copy(update={"workers": 3})
    assert changed.config.dataset is workspace.config.dataset


def test_a_wrong_setting_of_a_command_is_named(workspace: Workspace) -> None:
    """In one line, with where it was said."""
    with pytest.raises(ConfigError, match=r"^command line: run\.workers: .* greater than") as found:
        workspace.with_settings("run", workers=0)
    assert "\n" not in str(found.value)
