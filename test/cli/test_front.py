# SPDX-License-Identifier: Apache-2.0
"""What `selfcal` shows by itself: groups, where to start, examples, verbs of other packages."""

import os
import re
import shlex
import subprocess
import sys
from importlib import metadata

import pytest

from selfcal_ros.cli.main import EXTRAS, build_parser, main
from selfcal_ros.cli.verbs import EXAMPLES, GROUPS, START_HERE, VERBS, Verb, module_of
from test.support.pages import PAGES
from test.support.sources import ROOT
from test.support.terminals import SELFCAL, in_terminal


@pytest.mark.parametrize("words", [[], ["--help"], ["help"]])
def test_the_help_has_five_lines_to_start_and_every_verb_in_its_group(capsys, words):
    try:
        assert main(words) == 0
    except SystemExit as ended:
        assert ended.code == 0
    text, error = capsys.readouterr()
    blocks = {
        block.splitlines()[0]: block.splitlines()[1:] for block in text.split("\n\n")
    }
    assert not error and len(blocks["start here"]) == len(START_HERE) == 5
    for group in GROUPS:
        listed = {line.split()[0] for line in blocks[group] if line[2] != " "}
        assert listed == {name for name, verb in VERBS.items() if verb.group == group}
    assert all(len(line) <= 80 for line in text.splitlines())


def test_help_of_a_verb_is_that_of_its_option(capsys):
    shown = []
    for words in (["help", "plan", "check"], ["plan", "check", "--help"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
        shown.append(capsys.readouterr().out)
    assert (
        shown[0] == shown[1] and f"example:\n  {EXAMPLES['plan check']}\n" in shown[0]
    )


def ends(words):
    """Run a verb that ends with its help or with a line; return its exit code."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return ended.value.code


def leaves(parser, words=()):
    groups = [
        action for action in parser._actions if hasattr(action, "_name_parser_map")
    ]
    if not groups:
        yield " ".join(words), parser
    for group in groups:
        for word, sub in group._name_parser_map.items():
            yield from leaves(sub, (*words, word))


def test_every_option_has_a_page():
    text = " ".join(page.read_text() for page in PAGES)
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", text))
    options = {
        option
        for verb in VERBS
        for _, leaf in leaves(build_parser(verb))
        for option in leaf._option_string_actions
        if option.startswith("--")
    }
    assert options - {"--output"} <= named  # it is written as -o


@pytest.mark.parametrize("verb", VERBS)
def test_every_help_has_an_example_that_is_understood(verb):
    for words, leaf in leaves(build_parser(verb)):
        assert words in EXAMPLES, f"add '{words}' to EXAMPLES in cli/verbs.py"
        example = EXAMPLES[words]
        assert (
            example.startswith(f"selfcal {words} ")
            and f"\n  {example}\n" in leaf.format_help()
        )
        build_parser(verb).parse_args(shlex.split(example)[1:])
        for word in shlex.split(example):
            assert not word.startswith(("config/", "bags/")) or (ROOT / word).exists()


@pytest.mark.parametrize("verb", VERBS)
def test_every_help_says_what_the_verb_does(verb):
    for words, leaf in leaves(build_parser(verb)):
        assert leaf.description, f"selfcal {words} --help does not say what it does"


def test_the_help_of_a_verb_of_two_words_has_an_example_of_each(capsys):
    assert ends(["help", "cal"]) == 0
    said = capsys.readouterr().out
    for words, example in EXAMPLES.items():
        assert (f"\n  {example}\n" in said) == words.startswith("cal ")


def test_a_number_with_a_unit_is_told_the_unit_to_use(capsys):
    """6um is a sensible answer: the line says in which unit it is 6e-6."""
    assert ends(["detect", "bag", "-o", "b", "--pixel-size", "6um"]) == 2
    assert (
        "'6um' is not a number; give it in m, without a unit" in capsys.readouterr().err
    )
    assert ends(["help", "detect"]) == 0
    assert "side of a pixel on the plate, m;" in capsys.readouterr().out


def test_help_and_errors_are_readable_where_only_ascii_is():
    """A stream that has no µ gets a u, and no traceback."""
    for words, said in (
        (["gcode", "--help"], "from the programmed one, um"),
        (["step-diagonal", "--rest-tolerance", "2um"], "give it in um, without a unit"),
    ):
        done = subprocess.run(
            [*SELFCAL, *words],
            capture_output=True,
            text=True,
            env=os.environ | {"PYTHONIOENCODING": "ascii", "COLUMNS": "200"},
        )
        assert said in done.stdout + done.stderr, done


def test_verbs_are_registered_as_those_of_other_packages_are(tmp_path):
    subprocess.run(
        [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", tmp_path],
        cwd=ROOT,
        check=True,
    )
    [folder] = tmp_path.iterdir()
    registered = metadata.PathDistribution(folder).entry_points.select(
        group="selfcal.verbs"
    )
    assert {point.name: point.value for point in registered} == {
        name: module_of(name) for name in VERBS
    }


@pytest.fixture
def another_package(tmp_path, monkeypatch):
    """Install a package with the verbs hello, and solve, which exists."""
    folder = tmp_path / "hello_verbs-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: hello-verbs\nVersion: 1\nSummary: greet a stage\n"
    )
    (folder / "entry_points.txt").write_text(
        "[selfcal.verbs]\nhello = hello_verb\nsolve = hello_verb\n"
    )
    (tmp_path / "hello_verb.py").write_text(
        "def configure(parser):\n    parser.add_argument('name')\n"
        "def run(args):\n    print('hello', args.name)\n    return 5\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("another_package")
def test_another_package_adds_a_verb(capsys):
    assert main(["hello", "stage"]) == 5
    assert capsys.readouterr().out == "hello stage\n"
    assert main([]) == 0
    more = capsys.readouterr().out.partition("\nmore\n")[2]
    assert re.search(r"  hello +greet a stage \(package hello-verbs\)\n", more)
    assert build_parser("solve").parse_args(["solve", "b"]).run.__module__ == module_of(
        "solve"
    )


def test_a_verb_of_this_package_looks_for_no_other(monkeypatch):
    monkeypatch.setattr(metadata, "entry_points", None)
    build_parser("table")


def test_a_narrow_terminal_breaks_lines_between_words():
    code, said = in_terminal(SELFCAL, columns=68)
    assert code == 0 and all(len(line) <= 68 for line in said.splitlines())
    assert "take the map from them" in " ".join(said.split())


@pytest.mark.parametrize("closed", [{1}, {2}, {1, 2}, {0, 1, 2}])
@pytest.mark.parametrize(
    ("words", "code"), [("--version", 0), ("solve nothing.mcap", 2)]
)
def test_a_closed_stream_is_not_a_fault(tmp_path, closed, words, code):
    """The shell closes what `>&-` says; nothing else may take the place of a closed stream."""
    close = " ".join(f"{stream}{'<' if stream == 0 else '>'}&-" for stream in closed)
    done = subprocess.run(
        ["bash", "-c", f'"$0" -c "$2" {words} {close}', *SELFCAL],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code
    assert "Traceback" not in done.stderr and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("words", "code"), [("plan check no.yaml", 2), ("--help", 0)])
def test_nobody_reads_what_is_printed(words, code):
    """Both streams lead to a pipe whose reader is gone."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb", closefd=True) as pipe:
        done = subprocess.run(
            [*SELFCAL, *words.split()], stdout=pipe, stderr=pipe, check=False
        )
    assert done.returncode == code


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "words",
    [
        "",
        "--help",
        "--version",
        "help solve",
        "cal export --help",
        "plan check config/plans/hu.yaml",
    ],
)
def test_a_disk_that_is_full_is_said_in_a_line(words, unbuffered):
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [*SELFCAL, *words.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            cwd=ROOT,
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
        )
    assert done.returncode == 2
    assert re.fullmatch(r"selfcal[ a-z]*: .*No space left on device.*\n", done.stderr)


def test_a_line_that_does_not_fit_on_the_disk_leaves_the_exit_code():
    with open("/dev/full", "wb") as full:
        done = subprocess.run([*SELFCAL, "solve", "no.bag"], stderr=full, check=False)
    assert done.returncode == 2


def test_every_verb_is_in_a_group():
    assert all(
        isinstance(verb, Verb) and verb.group in GROUPS for verb in VERBS.values()
    )


def test_a_module_that_is_missing_is_named_with_the_extra_that_installs_it(
    monkeypatch, capsys
):
    """Each extra of setup.py has one, but that of the tests."""
    declared = (ROOT / "setup.py").read_text().partition("extras_require={")[2]
    extras = set(re.findall(r'^ +"(\w+)": \[', declared.partition("},")[0], re.M))
    assert set(EXTRAS.values()) == extras - {"test"}, "correct EXTRAS of cli/main.py"

    def lacks(name):
        raise ModuleNotFoundError(name=name)

    for module, remedy in (
        ("pymmcore", "pip install 'selfcal_ros[micromanager]'"),
        ("vendor", "pip install vendor"),
        ("yaml", "pip install pyyaml"),
        (
            "rclpy",
            "source a ROS 2 installation, or use the environment of `make setup`",
        ),
    ):
        monkeypatch.setattr("selfcal_ros.cli.table.run", lambda _, it=module: lacks(it))
        assert main(["table", "RESULT.json", "-o", "x.csv"]) == 2
        assert capsys.readouterr().err == (
            f"selfcal table: there is no module {module} in this environment; {remedy}\n"
        )
