# SPDX-License-Identifier: Apache-2.0
"""Every tool with options starts as the Makefile and the docs start it: by its path."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TOOLS = [
    path
    for path in sorted((ROOT / "tools").glob("*.py"))
    if "argparse.ArgumentParser" in path.read_text(encoding="utf-8")
]


EACH = """
import os, runpy, sys
path, tools = sys.path[1:], sys.argv[1:]
beside = tuple(os.path.abspath(folder) for folder in ("tools", "test"))
for tool in tools:
    gone = [name for name, module in sys.modules.items() if any(
        place.startswith(beside) for place in [getattr(module, "__file__", None) or "",
                                               *getattr(module, "__path__", ())])]
    for name in gone:
        del sys.modules[name]
    sys.path[:], sys.argv[:] = [os.path.dirname(tool), *path], [tool, "--help"]
    try:
        runpy.run_path(tool, run_name="__main__")
    except SystemExit as end:
        print("ended with", end.code)
"""
"""What a shell does for each tool, in one interpreter: what they import takes most of the time."""


def test_each_tool_starts_and_says_what_it_takes():
    started = subprocess.run(
        [sys.executable, "-c", EACH, *map(str, TOOLS)],
        cwd=ROOT,
        text=True,
        capture_output=True,
        check=False,
        timeout=120,
    )
    assert started.returncode == 0, started.stderr
    said = started.stdout.split("ended with 0\n")
    assert said.pop() == ""
    assert [text.split()[:2] for text in said] == [
        ["usage:", tool.name] for tool in TOOLS
    ]
