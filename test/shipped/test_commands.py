# SPDX-License-Identifier: Apache-2.0
"""Every command of README and docs is understood, and those that need no cell are run."""

import re
import shlex
from importlib.util import find_spec
from shutil import copyfile, copytree

import pytest

from selfcal_ros.cli.main import build_parser, main
from test.support.pages import PAGES, ROOT, code_lines

COMMAND = re.compile(r"^ *(?:\.venv/bin/)?(selfcal [a-z][^\n`]*?)(?: *# ?(.*))?$", re.M)
FILES = (
    re.compile(r"```yaml\n# (\w+\.yaml)\n(.*?)```", re.S),
    re.compile(r"```\w+ title=\"(\w+\.\w+)\"\n(.*?)```", re.S),
)
ONLY_PARSED = {
    "up": "needs a terminal",
    "monitor": "needs a cell",
    "call": "needs a cell",
    "replay": "run by test/nodes/test_image_player.py",
    "reproduce": "takes minutes; run small by test/cli/test_reproduce_verb.py",
    "plan new -o wide.yaml": "searches for long; shorter in test/cli/test_plan_new.py",
    "cell try": "asks a person; test/cli/test_cell_try.py",
    "measure examples/microscope": "needs pymmcore; run by test/machine/test_micromanager.py",
    "cell check": "needs a cell; test/nodes/test_cell_check.py",
}
"""Verbs whose commands are parsed alone, and why."""
PLACES = ("BAG", "/tmp/session", "$", "FILE.cal")
"""Words that stand for something of the reader's."""


def commands(text: str) -> list[tuple[str, int]]:
    """Return the commands in the code of a page, each with the exit code that it says."""
    found = []
    for command, comment in COMMAND.findall("\n".join(code_lines(text))):
        said = re.search(r"exit code (\d)", comment)
        found.append((command.split(" |")[0].strip(), int(said[1]) if said else 0))
    return found


def parsed_alone(command: str) -> bool:
    words = command.split()
    if words[1] == "report" and command.count(".pdf") and not find_spec("weasyprint"):
        return True  # nothing prints here
    return any(command.startswith(f"selfcal {verb}") for verb in ONLY_PARSED) or any(
        word in PLACES or word[0] == "$" for word in words
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_commands_are_understood(page):
    for command, _ in commands(page.read_text()):
        words = shlex.split(command)[1:]
        if "$" not in command:
            build_parser(words[0]).parse_args(words)


@pytest.fixture
def desk(tmp_path, monkeypatch, jumping_clocks):
    """Go to a folder with what the repository has at its root, and a result."""
    for name in ("config", "bags", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    for name in ("hu_exact", "hu_noise"):
        copytree(ROOT / "bags" / name, tmp_path / "ARCHIVE" / name)
    (tmp_path / "measured.csv").write_text(
        "position,error\n-10,0.4\n0,0\n10,-0.2\n20,0.1\n"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Return the result of a shipped bag."""
    file = tmp_path_factory.mktemp("solved") / "RESULT.json"
    assert main(["solve", str(ROOT / "bags/hu_noise"), "--quiet", "-o", str(file)]) == 0
    return file


@pytest.fixture(scope="module")
def checked():
    """Return a set that fills with the commands that check shipped plans: once is enough."""
    return set()


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_commands_run(page, desk, solved, checked, capsys):
    """In their order, as a reader runs them: a file is written before it is named, and once."""
    text = page.read_text()
    files = sorted(
        (found for kind in FILES for found in kind.finditer(text)), key=re.Match.start
    )
    run = [
        (command, code) for command, code in commands(text) if not parsed_alone(command)
    ]
    if "RESULT.json" in text and "-o RESULT.json" not in text:
        copyfile(solved, "RESULT.json")
    at = 0
    for command, code in run:
        at = text.index(command, at)
        while files and files[0].end() <= at:
            file = files.pop(0)
            (desk / file[1]).write_text(file[2])
        if (command, code) in checked:
            continue
        if command.startswith("selfcal plan check config/"):
            checked.add((command, code))
        words = shlex.split(command)
        if "-o" in words:  # the page says mkdir
            (desk / words[words.index("-o") + 1]).parent.mkdir(exist_ok=True)
        found = main(words[1:])
        printed = capsys.readouterr()
        assert found == code, f"{page.name}: {command}: {printed.err}"
        shown = text[at + len(command) :].lstrip("\n").splitlines()[0]
        if shown.startswith("{"):
            assert printed.out.strip() == shown, f"{page.name}: {command}"


def test_the_way_to_a_corrected_machine_is_whole():
    """All of it is run above, in its order, in one folder."""
    steps = commands((ROOT / "docs/start/drawing.md").read_text())
    assert not any(parsed_alone(command) for command, _ in steps)
    assert [(shlex.split(command)[1], code) for command, code in steps] == [
        ("plan", 0),
        ("plan", 2),
        ("plan", 0),
        ("plate", 0),
        ("plate", 0),
        ("measure", 0),
        ("history", 0),
        ("export", 0),
        ("measure", 0),
        ("measure", 5),
    ]


def test_the_tutorial_is_run_from_its_beginning_to_its_end():
    steps = [
        command
        for command, _ in commands((ROOT / "docs/start/tutorial.md").read_text())
    ]
    assert sum(not parsed_alone(command) for command in steps) == 9
    assert {shlex.split(command)[1] for command in steps} == {
        "plan",
        "simulate",
        "solve",
        "cal",
        "up",
    }


def headings(text: str) -> set[str]:
    """Return the names by which links reach the headings of a page, as mkdocs makes them."""
    found = re.findall(r"^#+ (.*)$", text, re.M)
    return {
        re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower())
        for title in found
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_to_files_and_headings(page):
    for address, heading in re.findall(
        r"\]\(([^)#]*)(?:#([^)]*))?\)", page.read_text()
    ):
        if address.startswith("http"):
            continue
        target = page.parent / address if address else page
        assert target.exists(), f"{page.name}: {address}"
        if heading:
            assert heading in headings(target.read_text()), (
                f"{page.name}: {address}#{heading}"
            )


def test_what_faq_quotes_is_what_the_code_says():
    """Each quoted message occurs in the source, where values stand for its blanks."""
    source = re.sub(
        r'"\s*\n?\s*f?"',
        "",
        "".join(
            path.read_text() for path in sorted((ROOT / "selfcal_ros").rglob("*.py"))
        ),
    )
    quoted = re.findall(r"^### `(.+)`$", (ROOT / "docs/start/faq.md").read_text(), re.M)
    assert len(quoted) >= 12
    for message in quoted:
        for part in re.split(" … |`, `", message):
            assert part.strip("… ") in source, message
