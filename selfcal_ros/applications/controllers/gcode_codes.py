# SPDX-License-Identifier: Apache-2.0
"""The codes that each dialect of G-code is known to have: effect, code, letters of its words.

From the sources of LinuxCNC 2.9, grbl 1.1, Marlin 2.1 and Klipper 0.13. All else is refused.
"""

from typing import NamedTuple

RS274 = """
rapid: G0 XYZ
line: G1 XYZ
arc: G2 G3 XYZIJ
cancel: G80
dwell: G4 P
home: G28 G30 XYZ
machine: G53
distance: G90 G91
unit: G20 G21
plane: G17
frame: G54 G55 G56 G57 G58 G59
offset: G49
other: G40 G91.1 G94 M3 M4 M5 M7 M8 M9
stop: M0 M1
end: M2 M30
"""
LINUXCNC = (
    RS274
    + """\
hole: G81 G85 XYZR
hole: G82 G86 G89 XYZRP
hole: G73 G83 XYZRQ
path: G61 G61.1
path: G64 PQ
offset: G43 H
unknown: M6
other: G97 G98 G99 M48 M49
"""
)
GRBL = (
    RS274
    + """\
other: G61
"""
)
KLIPPER = """
line: G0 G1 XYZEF
arc: G2 G3 XYZEFIJ
dwell: G4 PS
home: G28 XYZ
unknown: M18 M84 XYZES
set E: G92 E
distance: G90 G91
unit: G21
extruder: M82 M83
other: G17 M105 M107 M114 M115 M117 M400
other: M73 M104 M106 M109 M140 M190 M204 M220 M221 PRST
"""
MARLIN = (
    KLIPPER
    + """\
unknown: G29
other: M17 M201 M203 M205 M900 XYZEBJKST
stop: M0 M1 PS
"""
)
PRINTERS = ("marlin", "klipper")
"""Dialects in mm, with one command in a line, which is always named, and with the axis E."""
REMEDIES = {
    "G10 G52 G54 G55 G56 G57 G58 G59 G92 G92.1 G92.2 G92.3 M206 M428": (
        "set the frame before the program, and give its zero with --home-x and --home-y"
    ),
    "G43 G43.1 G49": "write G43 or G49 before the first move in X or Y",
    "G18 G19 R": "have arcs written in the XY plane, with I and J for their centre",
    "G20 G21": "write it once, before the first move",
    "G41 G41.1 G42 G42.1": "let the CAM program offset the path by the tool",
    "$": "send settings and homing by themselves, before the program",
    "/": "delete the line or the /: whether it is skipped is set at the machine",
    "* N": "leave numbers of lines and checksums to the sender",
    "# [ = < O": "have parameters, expressions and sub-programs replaced by plain moves",
    "K L P": "write each repeat, turn or hole as a line of its own",
    "T": "write a program for each tool",
}


class Code(NamedTuple):
    """A known code, its effect, and the letters of the words that belong to it."""

    name: str
    does: str
    words: str


def remedy(name: str) -> str:
    """Return what to do about a code, letter or character that is refused."""
    return next(
        (text for names, text in REMEDIES.items() if name in names.split()),
        "write the program without it",
    )


def _list(text: str) -> dict[str, Code]:
    """Return the codes of lines "effect: codes words" by their names."""
    codes: dict[str, Code] = {}
    for line in text.strip().splitlines():
        does, _, codes_and_words = line.partition(": ")
        names = codes_and_words.split()
        words = names.pop() if names[-1].isalpha() else ""
        codes |= {name: Code(name, does, words) for name in names}
    return codes


DIALECTS = {
    "linuxcnc": _list(LINUXCNC),
    "grbl": _list(GRBL),
    "marlin": _list(MARLIN),
    "klipper": _list(KLIPPER),
}
