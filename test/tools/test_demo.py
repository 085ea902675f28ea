# SPDX-License-Identifier: Apache-2.0
"""The picture of the map in letters that `make demo` shows in a terminal."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from test.support.results import known_result
from test.support.sources import ROOT
from test.support.terminals import in_terminal
from tools.demo import shades


def picture(size, fill):
    emap = known_result(size, 0)[0].error_map
    gx = np.zeros((size, size))
    fill(gx)
    return shades(replace(emap, gx=gx, gy=np.zeros_like(gx)))


def test_shades_stand_where_the_errors_are_with_y_upwards():
    def fill(gx):
        gx[2, 0], gx[0, 2], gx[1, 1] = 2e-6, -1e-6, np.nan

    lines = picture(3, fill)
    assert lines[:3] == ["  +    ", "    ?  ", "      @"]
    assert lines[3].startswith("  length of the error: from ' ' = 0 to '@' = 2 µm;")


def test_large_and_unknown_fields_are_small_pictures():
    lines = picture(101, lambda gx: gx.fill(np.nan))
    assert len(lines) == 26 and set("".join(lines[:-1])) == {" ", "?"}
    assert all(len(line) < 60 for line in lines[:-1])


@pytest.mark.ros
def test_the_demo_in_a_terminal_ends_with_its_picture_and_its_files():
    code, said = in_terminal([sys.executable, str(ROOT / "tools/demo.py")], folder=ROOT)
    assert code == 0, said
    assert "length of the error: from ' ' = 0 to '@' =" in said
    assert re.search(
        r"known to ±0\.0\d+ µm at the nodes, ±0\.0\d+ µm anywhere \(k=2\)", said
    )
    for name in ("result.json", "map.png", "report.html"):
        assert f"build/demo/{name}" in said and (ROOT / "build/demo" / name).exists()
