# SPDX-License-Identifier: Apache-2.0
"""The codes that each dialect of G-code is known to have: effect, code, letters of its words.

From the sources of LinuxCNC 2.9, grbl 1.1, Marlin 2.1 and Klipper 0.13. All else is refused.
"""

from typing import NamedTuple

RS274 = """
rapid: G0 XYZ
line: G1 XYZ
arc: G2 G3 XYZIJR
cancel: G80
dwell: G4 P
home: G28 G30 XYZ
machine: G53
probe: G38.2 G38.3 G38.4 G38.5 Z
tool length: G43.1 Z
distance: G90 G91
unit: G20 G21
plane: G17 G18 G19
frame: G54 G55 G56 G57 G58 G59
other: G40 G91.1 G94 M3 M4 M5 M7 M8 M9
stop: M0 M1
end: M2 M30
"""
LINUXCNC = RS274 + """\
hole: G81 G85 XYZR
hole: G82 G86 G89 XYZRP
hole: G73 G83 XYZRQ
path: G61 G61.1
path: G64 PQ
frame: G59.1 G59.2 G59.3
offset: G49
offset: G43 H
unknown: M6
other: G95 G97 G98 G99 M48 M49
stop: M60
"""
GRBL = RS274 + """\
tool length: G49
other: G61
"""
MARLIN = """
line: G0 G1 XYZEF
arc: G2 G3 XYZEFIJR
dwell: G4 PS
home: G28 XYZ
unknown: G29
unknown: M18 M84 XYZES
set E: G92 E
distance: G90 G91
unit: G21
extruder: M82 M83
other: G17 M75 M76 M77 M105 M107 M114 M115 M117 M118 M400
other: M17 XYZE
other: M104 M109 M140 M190 SRT
other: M106 PS
other: M73 PR
other: M155 M220 M221 S
other: M201 M203 XYZE
other: M204 PRST
other: M205 XYZEBJST
other: M300 SP
other: M900 K
stop: M0 M1 PS
"""
KLIPPER = """
line: G0 G1 XYZEF
arc: G2 G3 XYZEFIJ
dwell: G4 P
home: G28 XYZ
unknown: M18 M84
set E: G92 E
distance: G90 G91
unit: G21
extruder: M82 M83
other: G17 M105 M107 M114 M115 M117 M118 M400
other: M104 M109 M140 M190 ST
other: M106 S
other: M73 P
other: M204 SPT
other: M220 M221 S
"""
PRINTERS = ("marlin", "klipper")
"""Dialects in mm, with one command in a line, which is always named, and with the axis E."""
REMEDIES = {
    "G10 G52 G54 G55 G56 G57 G58 G59 G59.1 G59.2 G59.3 G92 G92.1 G92.2 G92.3 M206 M428":
        "set the frame before the program, and give its zero with --home-x and --home-y",
    "G43 G49": "write it before the first move in X or Y, or G43.1 with a length as Z",
    "G20 G21": "write it once, before the first move",
    "G41 G41.1 G42 G42.1": "let the CAM program offset the path by the tool",
    "$": "send settings and homing by themselves, before the program",
    "/": "delete the line or the /: whether it is skipped is set at the machine",
    "* N": "leave numbers of lines and checksums to the sender",
    "# [ = < O": "have parameters, expressions and sub-programs replaced by plain moves",
    "K L P": "write each repeat, turn or hole as a line of its own",
    "T": "write a program for each tool"}


class Code(NamedTuple):
    """A known code, its effect, and the letters of the words that belong to it."""

    name: str
    does: str
    words: str


def remedy(name: str) -> str:
    """Return what to do about a code, letter or character that is refused."""
    return next((text for names, text in REMEDIES.items() if name in names.split()),
                "write the program without it")


def _list(text: str) -> dict[str, Code]:
    """Return the codes of lines "effect: codes words" by their names."""
    codes: dict[str, Code] = {}
    for line in text.strip().splitlines():
        does, _, rest = line.partition(": ")
        names = rest.split()
        words = names.pop() if names[-1].isalpha() else ""
        codes |= {name: Code(name, does, words) for name in names}
    return codes


DIALECTS = {"linuxcnc": _list(LINUXCNC), "grbl": _list(GRBL), "marlin": _list(MARLIN),
            "klipper": _list(KLIPPER)}
