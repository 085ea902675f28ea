# SPDX-License-Identifier: Apache-2.0
"""Completion in the shell, asked as argcomplete's shell code asks."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("selfcal so", {"solve"}),
        ("selfcal cal", {"cal", "call"}),
        ("selfcal plan ", {"new", "check", "suggest"}),
        ("selfcal solve --meth", {"--method"}),
        ("selfcal solve --method ", {"joint", "law"}),
        ("selfcal cal ev", {"eval"}),
    ],
)
def test_words_are_completed(tmp_path, line, wanted):
    found = tmp_path / "found"
    environment = os.environ | {
        "_ARGCOMPLETE": "1",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(found),
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SUPPRESS_SPACE": "1",
    }
    code = "import sys; sys.argv[0] = 'selfcal'; from selfcal_ros.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0 and done.stdout == b""
    words = {word.strip() for word in found.read_text().splitlines()}
    assert words - {"-h", "--help"} == wanted


def test_help_loads_no_verb_and_no_numpy():
    code = (
        "import atexit, sys; from selfcal_ros.cli.main import main; "
        "atexit.register(lambda: print({'numpy', 'selfcal_ros.cli.solve'} & {*sys.modules}, "
        "file=sys.stderr)); main(['--help'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.stderr == "set()\n" and "solve" in done.stdout
