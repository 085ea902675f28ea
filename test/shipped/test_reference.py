# SPDX-License-Identifier: Apache-2.0
"""The reference is what `make reference` writes, and papers of the project agree with it."""

import importlib.util
from pathlib import Path

import pytest
import yaml

from selfcal_ros import __version__
from selfcal_ros.settings.nodes import NODE_PARAMETERS, NODE_SETTINGS, overrides_in

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tool():
    found = importlib.util.spec_from_file_location(
        "reference", ROOT / "tools/reference.py"
    )
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def result(tool):
    return tool.example()


def test_the_reference_is_current(tool, result):
    assert tool.PAGE.read_text() == tool.text(result), "run `make reference`"


def test_every_message_is_in_the_reference(tool):
    page = tool.PAGE.read_text()
    for path in (ROOT / "msg_defs/msg").iterdir():
        assert f"[{path.name}](../../msg_defs/msg/{path.name}) | " in page
    assert "| `views[].rotation_deg` |" in page


def test_the_file_of_all_parameters_is_current_and_changes_nothing(tool):
    assert tool.PARAMETERS.read_text() == tool.parameters_text(), "run `make reference`"
    read = yaml.safe_load(tool.PARAMETERS.read_text())
    assert list(read) == list(NODE_PARAMETERS)
    for node, declared in NODE_PARAMETERS.items():
        given = overrides_in(read, node, "all.yaml")
        assert given == {p.name: p.default for p in declared}
        assert NODE_SETTINGS[node].checked(given, "all.yaml") is not None


def test_a_key_that_is_not_described_is_named(tool, result):
    with pytest.raises(SystemExit, match=r"^RESULT\.json: \['novelty'\]$"):
        tool.text(result | {"novelty": 1})
    with pytest.raises(SystemExit, match=r"^PLAN\.yaml: b, c: described and not there"):
        tool.described(["a", "b"], {"a": "words", "c": "words"}, "PLAN.yaml")


def test_the_citation_is_of_this_version_and_names_no_person_as_author():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == __version__ and cited["cff-version"] == "1.2.0"
    assert cited["authors"] == [{"name": "the selfcal_ros contributors"}]
