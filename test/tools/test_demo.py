# SPDX-License-Identifier: Apache-2.0
"""The picture of the map in letters that `make demo` shows in a terminal."""

from dataclasses import replace

import numpy as np

from test.support.results import known_result
from tools.demo import map_picture


def picture(size, fill):
    emap = known_result(size, 0)[0].error_map
    gx = np.zeros((size, size))
    fill(gx)
    return map_picture(replace(emap, gx=gx, gy=np.zeros_like(gx)))


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
