# SPDX-License-Identifier: Apache-2.0
"""The pictures of the documents are those that `make pictures` makes, and all of them are shown."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)]+)\)")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@pytest.fixture(scope="module")
def made():
    """Return what `make pictures` would write: name -> text."""
    found = importlib.util.spec_from_file_location(
        "pictures", ROOT / "tools/pictures.py"
    )
    tool = importlib.util.module_from_spec(found)
    found.loader.exec_module(tool)
    return tool.pictures()


def test_pictures_are_made_by_the_tool_and_shown_in_the_documents(made):
    folder = ROOT / "docs/pictures"
    assert sorted(made) == sorted(path.name for path in folder.iterdir())
    shown = {
        (page.parent / address).resolve()
        for page in PAGES
        for _, address in PICTURE.findall(page.read_text())
    }
    assert shown == {folder / name for name in made}
    assert all(len(text) < 100_000 for text in made.values())


def test_committed_pictures_are_current(made):
    """The last digits of a solution differ between machines: by a step of rounding, no more."""
    for name, text in made.items():
        committed = (ROOT / "docs/pictures" / name).read_text()
        assert NUMBER.sub("", committed) == NUMBER.sub("", text), name
        places, drawn = (
            list(map(float, NUMBER.findall(svg))) for svg in (committed, text)
        )
        assert places == pytest.approx(drawn, rel=0, abs=0.11), name


def test_every_picture_says_what_it_shows():
    for page in PAGES:
        for words, _ in PICTURE.findall(page.read_text()):
            assert len(words) > 10, page.name
