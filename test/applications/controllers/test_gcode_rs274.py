# SPDX-License-Identifier: Apache-2.0
"""Corrected programs as LinuxCNC's own interpreter reads them, where it is installed."""

import numpy as np
import pytest

from selfcal_ros.applications.controllers.gcode import corrected_program
from test.applications.controllers.test_gcode import MILL, reached, rewriter_of
from test.support.gcode_machines import farthest
from test.support.rs274 import RS274, ways_of

DECIMALS_MM = 1.5e-4
"""Rounding of what the interpreter prints."""
PROGRAMS = {
    "modes": MILL,
    "relative": "%\nG21 G90 G17 G61\nF300 G0 X0 Y0 Z9\nG91 G1 X20 Z-1\nG90 g3 x16 y 4 i-4\nG2 J5\n"
    "G91\nG0 X-1 Y-1\nN9 G1 Y-3 (c) X.5 ; d\nG90 G1 X+.5 Y1.\n%\n",
    "cycles": "G21 G90 G17 G64 P0.01 Q0\nG0 X0 Y0 Z9 F100\nG99 G83 X5 Z-4 R2 Q1\nY6\n"
    "G98 G82 X7 R3 P.1 Z-1\nX3\nG0 Z9\nG73 X1 Y2 Z-1 R1 Q1\nG0 Z4\nG1 X9 Y9 Z3\nM2\n",
    "inches": "G20 G90 G17 G64\nG0 X0 Y0 Z.3 F9\nG1 X1.5\nG2 X.75 Y.75 I-0.75\nM30\n",
}


@pytest.mark.skipif(not RS274, reason="LinuxCNC is not installed")
@pytest.mark.parametrize("name", PROGRAMS)
def test_linuxcnc_reads_the_same_way(name, tmp_path):
    ways = []
    for text in (
        PROGRAMS[name],
        corrected_program(PROGRAMS[name], "a", rewriter_of("linuxcnc")),
    ):
        (tmp_path / "a.ngc").write_text(text)
        ways.append(ways_of(tmp_path / "a.ngc"))
    scale = 25.4 if name == "inches" else 1.0
    assert [feeds for feeds, _ in ways[0]] == [feeds for feeds, _ in ways[1]]
    moved = 0.0
    for (feeds, programmed), (_, commanded) in list(zip(*ways, strict=True))[1:]:
        way = np.hstack([reached(commanded[:, :2]), commanded[:, 2:]])
        if np.abs(commanded[-1] - programmed[-1]).max() < 1e-6:  # a stored place
            continue
        assert np.abs(way[-1] - programmed[-1]).max() < DECIMALS_MM * scale
        if feeds and len(commanded) > 1:
            moved += np.hypot(*np.diff(programmed[:, :2], axis=0).T).sum()
            assert farthest(way, programmed) < 1e-3 + DECIMALS_MM * scale
            assert farthest(programmed[::50], way) < 1e-3 + 2 * DECIMALS_MM * scale
    assert moved > (20 if name != "cycles" else 8)
