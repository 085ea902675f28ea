# SPDX-License-Identifier: Apache-2.0
"""Machines that run G-code as their documents and sources say, apart from the code under test.

Positions in mm. Each machine has what can go wrong: frames with other zeros, tools with offsets in
X, stored places, homing that ends elsewhere, a path mode that merges lines.
"""

import cmath
import math
import re
from typing import NamedTuple

import numpy as np

AXES = "XYZE"
FRAMES = {f"G{54 + n}": np.array([7.0 * n, 3.0 * n, n, 0]) for n in range(6)} | {
    "G59.1": np.array([50.0, 0, 0, 0]),
    "G59.2": np.array([0, 50.0, 0, 0]),
    "G59.3": np.array([50.0, 50, 0, 0]),
}
TOOLS = {0: np.zeros(4), 1: np.array([0, 0, 10.0, 0]), 2: np.array([3.0, -2, 12, 0])}
STORED = {"G28": np.array([-31.0, 33, 40, 0]), "G30": np.array([29.0, -37, 45, 0])}
PLACES = {
    "klipper": {
        "G28": STORED["G28"][:3],
        **dict.fromkeys(("M18", "M84"), (0.5, 0.5, 7)),
    }
}
PLACES["marlin"] = PLACES["klipper"] | dict.fromkeys(
    ("G29", "G34", "G27", "G30", "M600", "M125"), (11.0, -7, 3)
)
CHANGE = np.array([-44.0, -42, 60, 0])
INERT = {
    "linuxcnc": "G8 G40 G94 G97 G98 G99 M3 M4 M5 M7 M8 M9 M48 M49 G91.1 M0 M1 M60",
    "grbl": "G40 G61 G91.1 G94 M3 M4 M5 M7 M8 M9 M0 M1",
    "marlin": "G17 G21 M0 M1 M17 M73 M75 M76 M77 M104 M105 M106 M107 M109 M114 M115 M117 M118 M119 "
    "M140 M150 M155 M190 M201 M203 M204 M205 M220 M221 M300 M400 M500 M851 M900 M110",
    "klipper": "G17 G21 M104 M105 M106 M107 M109 M114 M115 M117 M118 M140 M190 M204 M220 M221 M400 "
    "M73 M110 M119",
}
"""Codes that change neither place, nor frame, nor mode."""
ACTS = [
    "G0",
    "G1",
    "G2",
    "G3",
    "G80",
    "G4",
    "G28",
    "G30",
    "G38.2",
    "G38.3",
    "G38.4",
    "G38.5",
    "G92",
    "G10",
]
CYCLES = {"linuxcnc": ("G73", "G81", "G82", "G83", "G85", "G86", "G89"), "grbl": ()}


class Wrong(Exception):
    """The controller stops, or would do something that this machine does not know."""


class Move(NamedTuple):
    """A motion: whether it is a traverse, its points (N, 4) of X, Y, Z, E, and feed, mm/min."""

    rapid: bool
    points: np.ndarray
    feed: float


class Machine:
    """A machine that runs a program line by line; a path mode must not merge a corrected one.

    Attributes
    ----------
    zero : array (4,), optional
        Of the program's frame at the first move in X or Y, in the machine's.
    """

    def __init__(
        self, dialect: str, *, inch: bool = False, corrected: bool = False
    ) -> None:
        self.dialect, self.printer = dialect, dialect in ("marlin", "klipper")
        self.at, self.inch = np.array([-1.5, 2.5, 20.0, 0.0]), inch
        self.relative = self.e_relative = False
        self.last_relative, self.motion, self.plane, self.frame = (
            False,
            None,
            "G17",
            "G54",
        )
        self.shift, self.tool, self.tool_in, self.prepared = (
            np.zeros(4),
            np.zeros(4),
            0,
            0,
        )
        if self.printer:  # G92 before the program
            self.shift[:2] = 2.0, -1.0
        self.feed, self.inverse, self.merging, self.ended = 0.0, False, 0.005, False
        self.strict = corrected and dialect == "linuxcnc"
        self.percent, self.moves, self.zero, self.sticky = 0, [], None, {}

    def run(self, line: str) -> list[Move]:
        """Return the moves of a line; Wrong if the controller stops."""
        self.moves = []
        if not self.ended:
            getattr(self, "_printer_line" if self.printer else "_line")(line)
        return self.moves

    @property
    def offset(self) -> np.ndarray:
        return FRAMES[self.frame] * (not self.printer) + self.shift + self.tool

    def _printer_line(self, line: str) -> None:
        line = line.partition(";")[0].strip()
        if not line:
            return
        if self.dialect == "klipper":
            parts = re.split("([A-Z_]+|[A-Z*])", line.upper())
            first = 3 if "".join(parts[:2]) == "N" else 0
            name = "".join(parts[first : first + (2 if first else 3)]).strip()
            words = {parts[i]: parts[i + 1].strip() for i in range(1, len(parts), 2)}
        else:
            match = re.match(r"(?:N[-+\d]+ *)?([GMT]) *(\d+(?:\.\d+)?)(.*)", line)
            if not match:
                return  # unknown command: an echo
            name = f"{match[1]}{int(match[2]) if match[2].isdigit() else match[2]}"
            words = {}
            for letter, value in re.findall(
                r"([A-Z]) *([-+]?[\d.]*)", match[3].partition("*")[0]
            ):
                words.setdefault(letter, value)
        if name.split(" ")[0] in ("M117", "M118"):
            return
        numbers = {}
        for letter, value in words.items():
            try:
                numbers[letter] = float(value)
            except ValueError:
                numbers[letter] = None
        self._printer_code(name, numbers)

    def _printer_code(self, name: str, words: dict) -> None:
        marlin = self.dialect == "marlin"
        if name in ("G0", "G1", "G2", "G3"):
            self._printer_move(name, words)
        elif name in ("G90", "G91", "M82", "M83"):
            self.last_relative = name in ("G91", "M83")
            if name[0] == "G":
                self.relative = self.last_relative
            else:
                self.e_relative = self.last_relative
        elif name == "G92":
            for axis, i in zip(AXES, range(4), strict=True):
                if axis in words or not words:
                    self.shift[i] = self.at[i] - (words.get(axis) or 0.0)
        elif name in PLACES[self.dialect]:
            self.at[:3] = PLACES[self.dialect][name]
            if name == "G28":  # of the homed axes
                named = [i for i, axis in enumerate("XYZ") if axis in words]
                self.shift[named or [0, 1, 2]] = 0.0
            self._traced()
        elif name in ("M206", "M218", "M665") or name.startswith(
            ("SET_GCODE_OFFSET", "T")
        ):
            self.shift[:2] += 4.0
        elif name not in ("G4", *INERT[self.dialect].split()):
            raise Wrong(
                "inches, if compiled in"
                if marlin and name == "G20"
                else f"not known: {name}"
            )

    def _printer_move(self, name: str, words: dict) -> None:
        if None in [words.get(a, 0) for a in "XYZEFIJR"] or words.get("F", 1) <= 0:
            raise Wrong("a word without a number, or no feed")
        if (
            name in ("G2", "G3")
            and self.dialect == "klipper"
            and (self.relative or "R" in words)
        ):
            raise Wrong("not of this firmware")
        self.feed = words.get("F", self.feed)
        end = self.at.copy()
        for axis, i in zip(AXES, range(4), strict=True):
            if axis in words:
                end[i] = words[axis] + (
                    self.at[i] if self._relative(axis) else self.offset[i]
                )
        self._go(name, end, words)

    def _relative(self, axis: str) -> bool:
        if axis != "E":
            return self.relative
        if (
            self.dialect == "marlin"
            and (self.relative or self.e_relative) != self.last_relative
        ):
            raise Wrong("old and new firmware differ")
        return self.relative or self.e_relative

    def _line(self, line: str) -> None:
        if line.strip() == "%":  # grbl answers with an error, and goes on
            self.percent += self.dialect == "linuxcnc"
            self.ended = self.percent > 1
            return
        if self.dialect == "grbl" and re.search(r"[!?~\x18]|[^\x00-\x7f]", line):
            raise Wrong("a realtime character")
        if self.dialect == "linuxcnc" and re.search(r"[(;]\s*(py|abort)", line, re.I):
            raise Wrong("runs a program")
        text = re.sub(r"\([^()]*\)|;.*", "", line)
        text = re.sub(r"\s", "", text).upper()
        if self.dialect == "linuxcnc" and text.startswith("/"):
            raise Wrong("perhaps skipped")
        text = text.replace("/", "") if self.dialect == "grbl" else text
        if not re.fullmatch(r"(?:[A-Z][-+]?(?:\d+\.?\d*|\.\d+))*", text):
            raise Wrong(f"not plain words: {text}")
        codes, words = [], {}
        for letter, value in re.findall(r"([A-Z])([-+.\d]+)", text):
            if letter in "GM":
                codes.append(f"{letter}{float(value):g}")
            elif letter in words:
                raise Wrong("a word twice")
            else:
                words[letter] = float(value)
        self._codes(codes, words)

    def _codes(self, codes: list[str], words: dict) -> None:
        unit = [c for c in codes if c in ("G20", "G21")]
        self.inch = unit[-1] == "G20" if unit else self.inch
        scale = 25.4 if self.inch else 1.0
        self.feed = words.get("F", self.feed / scale) * scale
        self.prepared = int(words.get("T", self.prepared))
        if "M6" in codes and self.dialect == "linuxcnc":
            self.tool_in, self.at = self.prepared, CHANGE.copy()
            self._traced()
        acts = [code for code in codes if code in ACTS or code in CYCLES[self.dialect]]
        for code in codes:
            if (
                code not in acts
                and not self._mode(code, words)
                and not self._offset(code, words, scale)
            ):
                raise Wrong(f"not known: {code}")
        if len(acts) > 1:
            raise Wrong("two motions")
        if acts and acts[0] in ("G0", "G1", "G2", "G3", "G80", *CYCLES[self.dialect]):
            self.sticky = self.sticky if self.motion == acts[0] else {}
            self.motion = None if acts[0] == "G80" else acts[0]
        moved = set("XYZ") & set(words)
        act = acts[0] if acts else self.motion if moved else None
        if act and (moved or act not in ("G0", "G1")) and "G43.1" not in codes:
            self._act(act, words, scale, machine="G53" in codes)
        self.ended |= bool({"M2", "M30"} & set(codes))

    def _mode(self, code: str, words: dict) -> bool:
        """Follow a mode; return whether it is one."""
        linuxcnc = self.dialect == "linuxcnc"
        if code in ("G17", "G18", "G19"):
            self.plane = code
        elif code in ("G90", "G91"):
            self.relative = code == "G91"
        elif code in ("G93", "G95"):
            self.inverse = code == "G93"
        elif code in ("G61", "G61.1", "G64") and linuxcnc:
            p = words.get("P", 0.0) if code == "G64" else 0.0
            self.merging = words.get("Q", p) if code == "G64" else 0.0
        else:
            return code in (
                "G53",
                "G20",
                "G21",
                "M2",
                "M30",
                *INERT[self.dialect].split(),
            ) or (code == "M6" and linuxcnc)
        return True

    def _offset(self, code: str, words: dict, scale: float) -> bool:
        """Follow what moves the frame; return whether it does."""
        linuxcnc = self.dialect == "linuxcnc"
        if code in FRAMES and (linuxcnc or "." not in code):
            self.frame = code
        elif code == "G49" or (code == "G43" and linuxcnc):
            number = int(words.get("H", self.tool_in)) if code == "G43" else 0
            self.tool = TOOLS.get(number, TOOLS[2]).copy()
        elif code == "G43.1":
            self.tool = self.tool.copy()
            for axis, i in zip("XYZ", range(3), strict=True):
                self.tool[i] = words.get(axis, self.tool[i] / scale) * scale
        else:
            return False
        return True

    def _act(self, act: str, words: dict, scale: float, *, machine: bool) -> None:
        end = self.at.copy()
        for axis, i in zip("XYZ", range(3), strict=True):
            if axis in words:
                base = (
                    0.0 if machine else self.at[i] if self.relative else self.offset[i]
                )
                end[i] = base + words[axis] * scale
        named = [i for i, axis in enumerate("XYZ") if axis in words]
        if act in ("G80", "G4"):
            if act == "G80" and named:
                raise Wrong("axes with G80")
        elif act in ("G92", "G10"):
            self.shift[:2] += 5.0
        elif act in ("G28", "G30"):
            if named:
                self._go("G0", end, words)
            self.at = self.at.copy()
            self.at[named or [0, 1, 2]] = STORED[act][named or [0, 1, 2]]
            self._traced()
        elif act.startswith("G38"):
            self.motion = None
            self._go("G1", self.at + 0.4 * (end - self.at), words)
        elif act in ("G0", "G1", "G2", "G3"):
            self._straight_or_arc(act, end, words, scale, machine=machine)
        else:
            self._cycle(act, words, end, scale)

    def _straight_or_arc(
        self, act: str, end: np.ndarray, words: dict, scale: float, *, machine: bool
    ) -> None:
        if act in ("G2", "G3"):
            self._arc_rules(words)
            if machine:
                raise Wrong("G53 with an arc")
        if act != "G0" and self.inverse and "F" not in words:
            raise Wrong("no time")
        self._go(
            act, end, {k: v * scale if k in "IJR" else v for k, v in words.items()}
        )

    def _arc_rules(self, words: dict) -> None:
        if self.plane != "G17" or "P" in words or "K" in words:
            raise Wrong("another arc")
        if self.dialect == "grbl" and not {"X", "Y"} & set(words):
            raise Wrong("grbl needs an end")
        if ("R" in words) == bool({"I", "J"} & set(words)):
            raise Wrong("R, or I and J")

    def _cycle(self, act: str, words: dict, end: np.ndarray, scale: float) -> None:
        if self.relative or self.plane != "G17" or "K" in words or "L" in words:
            raise Wrong("not a plain cycle")
        self.sticky |= {k: v for k, v in words.items() if k in "ZRPQ"}
        if not {"Z", "R"} <= set(self.sticky):
            raise Wrong("Z, R of the cycle")
        bottom, above = (self.sticky[k] * scale + self.offset[2] for k in "ZR")
        height = max(self.at[2], above)
        for x, y, z, code in (
            (*self.at[:2], height, "G0"),
            (*end[:2], height, "G0"),
            (*end[:2], bottom, "G1"),
            (*end[:2], above, "G0"),
        ):
            self._go(code, np.array([x, y, z, self.at[3]]), {})
        # where it ends depends on G98 and G99: only a stated Z is safe
        self.at[2] = above if len(self.moves) % 2 else height

    def _go(self, code: str, end: np.ndarray, words: dict) -> None:
        points = np.array([self.at, end])
        if code in ("G2", "G3"):
            points = self._arc(code, end, words)
        if np.abs(np.diff(points[:, :2], axis=0)).max() > 0:
            if self.zero is None:
                self.zero = self.offset.copy()
            if self.strict and self.merging and code != "G0":
                raise Wrong(f"lines are merged within {self.merging}")
        self.moves.append(Move(code == "G0" and not self.printer, points, self.feed))
        self.at = points[-1].copy()

    def _traced(self) -> None:
        """Record a place that the machine went to by itself."""
        self.moves.append(Move(True, self.at[None].copy(), 0.0))

    def _arc(self, code: str, end: np.ndarray, words: dict) -> np.ndarray:
        """Points by complex numbers: z = centre + (start - centre) e^(i angle)."""
        a, b = complex(*self.at[:2]), complex(*end[:2])
        left = 1 if code == "G3" else -1
        if "R" in words:
            r = words["R"]
            if a == b or abs(b - a) > 2 * abs(r) * (1 + 1e-9):
                raise Wrong("R does not fit")
            rise = math.sqrt(max(r * r - abs(b - a) ** 2 / 4, 0))
            side = left * (1 if r > 0 else -1)
            centre = (a + b) / 2 + side * rise * 1j * (b - a) / abs(b - a)
        else:
            if not {"I", "J"} & set(words):
                raise Wrong("no centre")
            centre = a + complex(words.get("I", 0.0), words.get("J", 0.0))
        if centre == a or abs(abs(b - centre) - abs(a - centre)) > 5e-3:
            raise Wrong("radii differ")
        turn = left * cmath.phase((b - centre) / (a - centre)) % (2 * math.pi)
        turn = 2 * math.pi if turn < 5e-7 else turn
        way = np.linspace(0, 1, 1500)
        z = centre + (a - centre) * np.exp(1j * left * turn * way)
        points = self.at + way[:, None] * (end - self.at)
        points[:, 0], points[:, 1] = z.real, z.imag
        points[-1] = end
        return points


def run_both(text: str, rewriter, true, tolerance_mm: float, **kwargs) -> int:
    """Run a program and its correction, compare their ways, and return the number of pieces.

    `true` gives the places that are reached when places (N, 2), mm, are commanded. The way of a
    traverse is free, and that of a move from where a homing or the like has ended. A program by
    which the controller stops ends there.
    """
    dialect, pieces, known = rewriter.dialect, 0, False
    machine, second = (
        Machine(dialect, **kwargs),
        Machine(dialect, corrected=True, **kwargs),
    )
    program = [
        (line, rewriter.line(line.removesuffix("\r"), f"a.nc:{number}"))
        for number, line in enumerate(text.split("\n"), 1)
    ]
    for line, lines in program:
        try:
            ideal = machine.run(line)
        except Wrong:
            return pieces
        made = [move for one in lines for move in second.run(one)]
        pieces += len(made)
        # nothing, or it goes to a place of its own
        if not ideal or len(ideal[-1].points) == 1:
            assert len(made[-1:]) == len(ideal[-1:])
            for here, there in zip(made[-1:], ideal[-1:], strict=True):
                off = np.abs(here.points[-1] - there.points[-1])
                way = true(here.points[-1:, :2])[0]
                stays = known and np.abs(way - there.points[-1, :2]).max() < 3e-5
                assert off.max() < 3e-5 or (stays and off[2:].max() < 3e-5)
                known = stays
            continue
        in_xy = any(np.ptp(m.points[:, :2], axis=0).any() for m in (*ideal, *made))
        if len(ideal) > 1:  # a cycle: compare its bottom
            assert len(made) == len(ideal)
            ideal, made = ideal[-2:-1], made[-2:-1]
        (whole,), zero = (
            ideal,
            machine.zero if machine.zero is not None else np.zeros(4),
        )
        assert {move.rapid for move in made} == {whole.rapid}
        assert {move.feed for move in made} == {whole.feed}
        way = np.concatenate(
            [
                m.points[0]
                + np.linspace(0, 1, 30)[:, None] * (m.points[-1] - m.points[0])
                for m in made
            ]
        )
        if in_xy or known:
            way[:, :2] = true(way[:, :2] - zero[:2]) + zero[:2]
        assert np.abs(way[-1] - whole.points[-1]).max() < 3e-5
        if in_xy and known and not whole.rapid:
            assert farthest(way[::7], whole.points) < tolerance_mm
            assert farthest(whole.points[::40], way) < tolerance_mm
        known |= in_xy
    return pieces


def farthest(points: np.ndarray, path: np.ndarray) -> float:
    """Return the largest distance of points (N, D) from a path through points (M, D)."""
    a, d = path[:-1], np.diff(path, axis=0)
    length2 = np.maximum((d**2).sum(axis=1), 1e-30)
    t = np.clip(((points[:, None] - a) * d).sum(axis=2) / length2, 0, 1)
    off = a + t[:, :, None] * d - points[:, None]
    return float(np.sqrt((off**2).sum(axis=2)).min(axis=1).max())
