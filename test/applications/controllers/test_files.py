# SPDX-License-Identifier: Apache-2.0
"""What each controller does with a file, in numbers worked out by hand from its documents."""

import re

import numpy as np
import pytest

from selfcal_ros.applications.controllers.export import FORMATS
from selfcal_ros.applications.controllers.grid import Source, Wiring, numbers
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError

MM = MachineFrame(1, 2)


def corrections(name, texts, x, y, wiring=None):
    texts = [texts] if isinstance(texts, str) else texts
    sources = [Source(text, f"file{n}") for n, text in enumerate(texts)]
    return tuple(
        float(c)
        for c in FORMATS[name].read(sources, wiring or Wiring(MM))(
            np.array(float(x)), np.array(float(y))
        )
    )


GEO = (
    "2,3\n10,20\n-10,5\n0,0,-9.9,5.1,0\n0,1,0,5,0\n0,2,10,5,0\n1,0,-10,25.4,0\n1,1,0.8,25,0\n"
    "1,2,10,25,0\nwhat follows is not read"
)


@pytest.mark.parametrize(
    "x, y, cx, cy",
    [
        (
            -10,
            5,
            0.1,
            0.1,
        ),  # row 0, column 0: the offset is its position, the values are absolute
        (-10, 25, 0.0, 0.4),
        (0, 25, 0.8, 0.0),
        (10, 5, 0.0, 0.0),  # row along y, column along x
        (-5, 15, (0.1 + 0.0 + 0.0 + 0.8) / 4, (0.1 + 0.0 + 0.4 + 0.0) / 4),
        (-10, 45, -0.1, 0.7),  # the edge cell extrapolates
        (-20, 5, 0.2, 0.2),
    ],
)
def test_kmotion(x, y, cx, cy):
    assert corrections("kmotion", GEO, x, y) == pytest.approx((cx, cy), abs=1e-12)


PMAC = """; two rows, three columns: #1 is the row motor, and columns are along it
#2
DEFINE COMP 2.3,#1D,#2D,#2,3000,4000
16 32 48
64 80 96 112
128 144 160 176
#1
DEFINE COMP 2.3,#1D,#2D,#1,3000,4000
-16 0 0 0 0 0 0 0 0 0 0
I51=1
"""


@pytest.mark.parametrize(
    "x, y, cx, cy",
    [
        (0, 0, 0, 0),  # entry [0, 0] is zero and not written
        (1000, 0, -1, 1),
        (2000, 0, 0, 2),
        (3000 - 1e-9, 0, 0, 3),
        (0, 2000, 0, 4),
        (1000, 2000, 0, 5),
        (0, 4000 - 1e-9, 0, 8),
        (500, 0, -0.5, 0.5),
        (1000 - 3000, 2000, 0, 5),
        (1000, 2000 + 4000, 0, 5),
    ],
)  # rolls over
def test_pmac(x, y, cx, cy):
    """In counts: 100 for a unit of x, 50 of y."""
    wiring = Wiring(MM, counts=(100.0, 50.0))
    found = corrections("pmac", PMAC, x / 100, y / 50, wiring)
    assert found == pytest.approx((cx / 100, cy / 50), abs=1e-9)


def lists(slave):
    """Three points along master 1 (10 mm apart from -40 mm), two along master 2 from -70 mm."""
    rows = [(j, i, 100 * slave + 10 * j + i) for j in range(2) for i in range(3)]
    return "\n".join(
        [
            "# *** axis",
            f"kopf.achs_nr {slave}",
            "kopf.log_achs_name X",
            "kw.crosscomp2.interval 100000 /* 10 mm */",
            "kw.crosscomp2.last_index_master1 2",
            "kw.crosscomp2.last_index_master2 1",
            "kw.crosscomp2.start_position_master1 -400000",
            "kw.crosscomp2.start_position_master2 -700000",
            "kw.crosscomp2.unit 1 /* 0,1 my */",
            "kw.crosscomp2.master1_ax_nr 1",
            "kw.crosscomp2.master2_ax_nr 2",
            "kw.crosscomp2.n_cycles 20",
            *(
                f"kw.crosscomp2.table[  {j}][ {i}].correction {value}"
                for j, i, value in rows
            ),
        ]
    )


@pytest.mark.parametrize(
    "x, y, tenths",
    [
        (-40, -70, 0),
        (-30, -70, 1),
        (-20, -70, 2),
        (-40, -60, 10),
        (-20, -60, 12),
        (-25, -65, 6.5),
        (-99, -70, 0),
        (50, 50, 12),
    ],
)  # the edge holds
@pytest.mark.parametrize("sense", [1, -1])
def test_beckhoff(x, y, tenths, sense):
    found = corrections(
        "beckhoff", [lists(2), lists(1)], x, y, Wiring(MM, negate=sense < 0)
    )
    assert found == pytest.approx(
        [sense * (100 + tenths) * 1e-4, sense * (200 + tenths) * 1e-4], abs=1e-12
    )


@pytest.mark.parametrize(
    "key, value",
    [
        ("interval", "0"),
        ("unit", "0"),
        ("last_index_master1", "-1"),
        ("master2_ax_nr", "3"),
    ],
)
def test_a_beckhoff_list_of_another_grid_is_refused(key, value):
    other = re.sub(rf"(crosscomp2\.{key}) \d+", rf"\1 {value}", lists(1))
    with pytest.raises(
        InputError, match=r"unit 1, masters \[1, 2\] and a positive interval"
    ):
        corrections("beckhoff", [other, lists(2)], 0, 0)


def test_numbers_are_those_that_a_double_holds_to_the_integer():
    assert numbers("999999999999999 -9e14", "file:1", r"N\s+N") == [
        999999999999999,
        -9e14,
    ]
    for text in ("1e15", "-1e15"):
        with pytest.raises(InputError, match="file:1: a number is too large"):
            numbers(text, "file:1", "N")


@pytest.mark.parametrize(
    "x, y, cx, cy",
    [
        (0, 0, 0, 0),
        (0.1, 0, 0.001258, 0),
        (0.2, 0.5, 0.028471, 0.25),
        (9, 9, 0.028471, 0.5),
        (-9, 0, 0, 0),
        (0.05, 0, 0.000629, 0),
    ],
)
def test_linuxcnc(x, y, cx, cy):
    """Nominal - forward is added, linearly; beyond the ends it stays."""
    texts = [
        "0.0 0.0 0.0\n0.1 0.098742 0.098742\n0.2 0.171529 0.171529\n# the end\n0.3 7 7\n",
        "0 0 0\n1 0.5 0.5\n",
    ]
    assert corrections("linuxcnc", texts, x, y) == pytest.approx((cx, cy), abs=1e-12)


CEC = "\n".join(
    [
        "%_N_NC_CEC_INI",
        "CHANDATA(1)",
        *(
            line
            for table, (source, output, values) in enumerate(
                [
                    (1, 2, (0.001, 0.003, 0.002)),
                    (2, 1, (0.01, 0.02)),
                    (2, 2, (0.1, 0.3)),
                ]
            )
            for line in [
                *(
                    f"$AN_CEC[{table},{n}]={value} ; a value"
                    for n, value in enumerate(values)
                ),
                f"$AN_CEC_INPUT_AXIS[{table}]=(AX{source})",
                f"$AN_CEC_OUTPUT_AXIS[{table}]=(AX{output})",
                f"$AN_CEC_STEP[{table}]=10.0",
                f"$AN_CEC_MIN[{table}]=-5",
                f"$AN_CEC_MAX[{table}]={-5 + 10 * (len(values) - 1)}",
                f"$AN_CEC_DIRECTION[{table}]=0",
                f"$AN_CEC_MULT_BY_TABLE[{table}]=0",
                f"$AN_CEC_IS_MODULO[{table}]=0",
            ]
        ),
        "M17",
    ]
)


@pytest.mark.parametrize(
    "x, y, cx, cy",
    [
        (-5, -5, 0.01, 0.101),
        (5, -5, 0.01, 0.103),
        (15, 5, 0.02, 0.302),
        (0, 0, 0.015, 0.202),
        (-99, 99, 0.02, 0.301),
    ],
)
@pytest.mark.parametrize("sense", [1, -1])
def test_siemens(x, y, cx, cy, sense):
    found = corrections("siemens", CEC, x, y, Wiring(MM, negate=sense < 0))
    assert found == pytest.approx((sense * cx, sense * cy), abs=1e-12)
