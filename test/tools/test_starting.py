# SPDX-License-Identifier: Apache-2.0
"""Every tool with options starts as the Makefile and the docs start it: by its path."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOOLS = [path for path in sorted((ROOT / "tools").glob("*.py"))
         if "argparse.ArgumentParser" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("tool", TOOLS, ids=lambda path: path.stem)
def test_a_tool_starts_and_says_what_it_takes(tool):
    started = subprocess.run([sys.executable, tool, "--help"], cwd=ROOT, text=True,
                             capture_output=True, check=False, timeout=120)
    assert started.returncode == 0, started.stderr
    assert started.stdout.startswith("usage: ")
