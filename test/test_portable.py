# SPDX-License-Identifier: Apache-2.0
"""Bags and results are worked on without what only Linux and macOS, or Linux alone, have."""

import json
import shlex
import subprocess
import sys

import pytest

from test.support.sources import ROOT

WITHOUT = """
import os, shlex, shutil, signal, sys
shutil._use_fd_functions = False  # as where os has no dir_fd
for name in ("fcntl", "termios", "tty", "pty", "resource", "pwd", "grp"):
    sys.modules[name] = None
for module, names in ((os, ("O_NONBLOCK", "O_NOFOLLOW", "O_CLOEXEC", "sched_getaffinity")),
                      (signal, ("pthread_sigmask", "SIGHUP", "SIGKILL"))):
    for name in names:
        delattr(module, name)
from selfcal_ros.start import selfcal
code = 0
for line in sys.stdin.read().splitlines():
    sys.argv = ["selfcal", *shlex.split(line)]
    found = selfcal()
    print("code", found, line, file=sys.stderr)
"""
"""A process in which the modules and names that Windows lacks are missing."""


def run(folder, *lines):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT],
        input="\n".join(lines),
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [
        line for line in done.stderr.splitlines() if line.startswith("code ")
    ], done.stderr


def test_from_bag_to_map_report_and_tables(tmp_path):
    root = shlex.quote(str(ROOT))
    bag = f"{root}/bags/demo"
    (tmp_path / "points.csv").write_text("x,y\n0,0\n")
    lines = (
        f"solve {bag} -o r.json --quiet",
        "report r.json",
        "plot r.json -o m.svg",
        "table r.json -o t.csv",
        "apply r.json points.csv -o c.csv",
        "diff r.json r.json",
        "export siemens r.json -o t.ini --unit mm",
        "cal export r.json -o s.cal",
        f"batch {bag} -o batch --workers 1",
        f"plan check {root}/config/plans/hu.yaml",
        f"simulate {root}/config/simulations/recheck.yaml -o simulated",
    )
    codes, error = run(tmp_path, *lines)
    assert codes == [f"code 0 {line}" for line in lines], error
    assert json.loads((tmp_path / "r.json").read_text())["verdict"]["qualified"]
    assert not list(tmp_path.glob(".selfcal*"))


@pytest.mark.parametrize("verb", ["monitor", "up --plan p.yaml"])
def test_what_runs_nodes_says_that_it_needs_linux(tmp_path, verb):
    codes, error = run(tmp_path, verb)
    assert codes == [f"code 2 {verb}"]
    assert "install it" not in error and error.count("\n") == 2
    assert "needs Linux" in error
