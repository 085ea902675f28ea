# SPDX-License-Identifier: Apache-2.0
"""Corrected G-code for controllers without tables: each point p is commanded as p + c(p).

Lines and arcs of the XY plane are split so that the corrected path stays within a chord tolerance.
What a code does is read from the list of its dialect. Every other code, word and character is
refused, and so is a move that needs a position or a mode that the program has not stated.
Points are complex numbers, x + iy.
"""

import cmath
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from selfcal_ros.applications.controllers.gcode_codes import (
    DIALECTS,
    PRINTERS,
    Code,
    remedy,
)
from selfcal_ros.compensation.residual import Correction
from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER_INCH, M_PER_MM

VALUE = r"([-+]?(?:\d+\.?\d*|\.\d+))"
WORD = re.compile(rf"([A-Za-z])[ \t]*{VALUE}|(;.*|\([^()]*\))|[ \t]+", re.ASCII)
PRINTER_WORD = re.compile(rf"([A-Z]){VALUE}?|(;.*)| +", re.ASCII)
"""Letter, value and comment."""
EXTRUDES = re.compile(r"^ *G1\b[^;\n]*E", re.MULTILINE)
"""A line that extrudes: in a program with such lines, those without E are travels."""
CONTROL = r"[\x00-\x08\x0a-\x1f\x7f]"
FORBIDDEN = {"linuxcnc": rf"{CONTROL}|[(;]\s*(?i:py|abort)", "grbl": r"[!?~]|[^ -~\t]"}
"""Comments that run Python or stop; characters that are obeyed at once, even in comments."""
ALWAYS = "NFST"
"""Words that each line of a controller may have; a printer has one command in a line."""
MOVES = ("rapid", "line", "arc", "hole")
ACTS = (*MOVES, "cancel", "dwell", "home", "unknown", "set E")
FRAMES = ("unit", "frame", "offset")
MODES = (*FRAMES, "distance", "plane", "path", "extruder")
IN_PLANE = ("arc", "hole")
NEEDED = {"distance": MOVES, "unit": MOVES, "plane": IN_PLANE, "path": ("line", "arc")}
"""Modes without which these moves are not understood, where the dialect has them."""
FORGETS = {"home": "XYZE", "unknown": "XYZE", "hole": "Z", "machine": "Z"}
"""Axes whose position is not known after a code."""
OF_SAMPLES = 1 / 8
"""Part of the chord tolerance for the distance of the points on which the path is judged."""
MAX_SAMPLES = 1_000_000
NO_TURN_RAD = 1e-4
"""Sweep of an arc that a controller may take for a full turn."""
MAX_WORDS, MAX_LINE, MAX_COMMENT = 79, 255, 200
"""Characters of a line that grbl reads without blanks and comments, LinuxCNC with them."""


@dataclass
class ProgramLine:
    """A line as it was read.

    Attributes
    ----------
    codes : list of Code
        Those that it names, and the modal one by which it moves.
    values : dict
        Texts of the numbers of all other words by their letters; "" for a letter alone.
    comments : list of str
    """

    codes: list[Code]
    values: dict[str, str]
    comments: list[str]

    def number(self, letter: str) -> float:
        """Return the number of a word, 0 if there is none."""
        return float(self.values.get(letter) or 0)

    def named(self, letters: str) -> list[str]:
        """Return which of these letters have words."""
        return [letter for letter in letters if letter in self.values]

    def code(self, *effects: str) -> Code | None:
        """Return the code with one of these effects."""
        return next((code for code in self.codes if code.does in effects), None)


def corrected_program(text: str, where: str, rewriter: "Rewriter") -> str:
    """Return a program with corrected moves; InputError names a line that cannot be corrected."""
    out: list[str] = []
    rewriter.prints = rewriter.dialect in PRINTERS and bool(EXTRUDES.search(text))
    for number, line in enumerate(text.split("\n"), 1):
        end = "\r" * line.endswith("\r")
        lines = rewriter.line(line.removesuffix("\r"), f"{where}:{number}")
        out += [corrected + end for corrected in lines]
    return "\n".join(out)


def commented(program: str, comments: Sequence[str]) -> str:
    """Return a program with comments as its first lines, after a %."""
    newline = "\r\n" if "\r\n" in program else "\n"
    begins = re.match(r"\s*%[^\n]*\n", program)
    head = begins[0] if begins else ""
    lines = [
        "; " + re.sub("[^ -~]|[!?~]", "_", text[:MAX_COMMENT]) + newline
        for text in comments
    ]
    return head + "".join(lines) + program[len(head) :]


class Rewriter:
    """What a program has stated so far, and its corrected lines.

    Parameters
    ----------
    correct : Correction
        Correction of positions x, y; both in m.
    dialect : str
        A key of DIALECTS.
    tolerance_m : float
        Largest distance of the corrected path from the commanded one.
    step_m : float
        Largest distance of points at which the correction is looked up on a line.
    decimals : int
        Of coordinates in mm; one more in inches.
    """

    def __init__(
        self,
        correct: Correction,
        *,
        dialect: str,
        tolerance_m: float,
        step_m: float,
        decimals: int = 5,
    ) -> None:
        self._correct = correct
        self._tolerance_m = tolerance_m
        self._step_m = step_m
        self._decimals = decimals
        self.dialect = dialect
        self._codes = DIALECTS[dialect]
        self._printer = dialect in PRINTERS
        self.prints = False
        self._modes = {"unit": "G21"} if self._printer else {}
        self._motion: Code | None = None
        self._at = dict.fromkeys("XYZE", math.nan)  # as programmed; nan if not known
        self._sent = dict.fromkeys("XYZE", 0.0)  # as commanded
        self._begun = self._ended = self._drawn = False
        self._homed: set[str] = set()  # axes, before the first move
        self._frame_ended = False
        self._where = ""
        self.moves = self.pieces = 0
        self.reach_m = np.array([[math.inf] * 2, [-math.inf] * 2])
        """Least and largest x, y of the moves, m."""

    def line(self, text: str, where: str) -> list[str]:
        """Return the lines that replace a line; InputError if one cannot be corrected."""
        self._where = where
        acting = re.search(FORBIDDEN.get(self.dialect, CONTROL), text)
        if acting:
            self._refuse(
                f"{acting[0]!r} acts on {self.dialect} even in a comment", "remove it"
            )
        content = text.strip()
        if content == "%" and not self._printer:
            self._ended |= self._begun
            self._begun = True
            return [text]
        self._begun |= bool(content)
        if self._printer and content.split()[:1] == ["M117"]:
            return [text]

        line = self._read(text)
        self._check(line)
        for code in line.codes:
            self._set_mode(code)
        lines = [text]
        act = line.code(*MOVES)
        if act and (line.named("XYZE") or act.does in IN_PLANE):
            lines = self._move_lines(act, line)
        if line.code("set E"):
            self._at["E"] = line.number("E")
        if line.code("home") and self._printer:
            self._end_offset(line)
        for code in line.codes:
            self._at |= dict.fromkeys(FORGETS.get(code.does, ""), math.nan)
        return lines

    def _refuse(self, what: str, mend: str) -> NoReturn:
        raise InputError(self._where, what, mend)

    def _read(self, text: str) -> ProgramLine:
        """Return the codes, words and comments of a line."""
        pattern = PRINTER_WORD if self._printer else WORD
        unmatched = pattern.sub("", text)
        if unmatched:
            self._refuse(
                f"{unmatched[0]!r} does not belong to a word of {self.dialect}",
                remedy(unmatched[0].upper()),
            )
        line = ProgramLine([], {}, [])
        for letter, value, comment in pattern.findall(text):
            letter = letter.upper()
            if comment:
                line.comments.append(comment)
            elif letter in ("G", "M"):
                line.codes.append(self._code(letter, value))
            elif letter in line.values:
                self._refuse(f"{letter} is given twice", "keep one of them")
            elif letter and self._printer and not line.codes:
                self._refuse("the line does not begin with a command", remedy(letter))
            elif letter:
                line.values[letter] = value
        names_axes = line.named("XYZ") and not self._printer
        if names_axes and not line.code(*ACTS):
            if not self._motion:
                self._refuse("the line does not name its command", "begin it with one")
            line.codes.append(self._motion)
        return line

    def _code(self, letter: str, value: str) -> Code:
        """Return a code of the list; printers may know it in one way of writing only."""
        name = f"{letter}{float(value or math.nan):.10g}"
        if name not in self._codes:
            self._refuse(
                f"{letter}{value} is not in the list of codes that are known of {self.dialect}",
                remedy(name),
            )
        if self._printer and name != letter + value:
            self._refuse(
                f"{letter}{value} is not understood by all firmware", f"write {name}"
            )
        return self._codes[name]

    def _check(self, line: ProgramLine) -> None:
        """Refuse codes that do not agree, and words that do not belong to one of them."""
        names = " ".join(code.name for code in line.codes)
        acts = [code for code in line.codes if code.does in ACTS]
        modes = [code.does for code in line.codes if code.does in MODES]
        conflicting = {"linuxcnc": ["path"], "grbl": ["offset"]}.get(self.dialect, [])
        crowded = len(line.codes) > 1 and (
            self._printer or bool(acts and {*conflicting} & {*modes})
        )
        if crowded or len(acts) > 1 or len(modes) > len(set(modes)):
            self._refuse(f"{names} in one line", "write a line for each")
        letters = "".join(code.words for code in line.codes) + ALWAYS * (
            not self._printer
        )
        for letter, value in line.values.items():
            if letters.count(letter) != 1:
                self._refuse(
                    f"{letter} is not a word of {names or self.dialect}", remedy(letter)
                )
            if not value and not line.code("home", "unknown"):
                self._refuse(f"{letter} has no number", "give one")
            if letter == "F" and float(value) <= 0:  # of the first piece alone
                self._refuse(f"F{value} is not a feed", "give one above 0")

        if self._ended and (line.codes or line.values):
            self._refuse("the line follows the end of the program", "remove it")
        if line.code(*MOVES) and line.code("stop", "end"):
            self._refuse(
                "the program stops in the line of a move", "stop in the next line"
            )
        if line.code("machine") and (
            line.named("XY") or not line.code("rapid", "line")
        ):
            self._refuse(
                "G53 leaves the frame of the map", "write G0 or G1, and Z alone"
            )
        if line.code("home") and not self._printer and line.named("XY"):
            self._check_way_home(line)
        if line.code("path") and float(line.values.get("Q", line.number("P"))):
            self._refuse(
                "G64 P merges the pieces of corrected lines", "write Q0 behind it"
            )
        if line.code("set E") and not line.values:
            self._refuse("G92 moves the frame", remedy("G92"))

    def _check_way_home(self, line: ProgramLine) -> None:
        """Refuse G28 and G30 by way of a point that is not where the stage is."""
        distance = line.code("distance")
        mode = distance.name if distance else self._modes.get("distance")
        if mode != "G91" or line.number("X") or line.number("Y"):
            self._refuse(
                "the way home passes a point that is not corrected",
                "write G91 with it, and X0, Y0",
            )

    def _end_offset(self, line: ProgramLine) -> None:
        """Follow that homing ends an offset of G92 that was in force before the program."""
        if not self._drawn:
            self._homed |= {*(line.named("XYZ") or "XY")}
        elif line.named("XYZ") != ["Z"]:
            self._frame_ended = not {*"XY"} <= self._homed

    def _set_mode(self, code: Code) -> None:
        """Follow a mode."""
        if code.does in FRAMES and (
            self._modes.get(code.does) != code.name or code.words
        ):
            if self._drawn:
                self._refuse(f"{code.name} follows a move in X or Y", remedy(code.name))
            self._at = dict.fromkeys("XYZE", math.nan)
        if code.name == "G90" and self._modes.get("extruder") == "M83":
            del self._modes["extruder"]
        if code.name == "M82" and self._modes.get("distance") == "G91":
            self._refuse("firmware disagrees on M82 after G91", "write G90 before M82")
        if code.does in MODES:
            self._modes[code.does] = code.name
        if code.does in (*MOVES, "cancel"):
            self._motion = code if code.does in MOVES else None
        self._ended |= code.does == "end"

    def _move_lines(self, act: Code, line: ProgramLine) -> list[str]:
        """Return the lines of a move, each with its command."""
        relative = self._modes.get("distance") == "G91"
        for mode, moves in NEEDED.items():
            names = [code.name for code in self._codes.values() if code.does == mode]
            if names and act.does in moves and mode not in self._modes:
                self._refuse(
                    f"the program has not said {' or '.join(names)}",
                    "write it before the first move",
                )
        if line.named("E") and not relative and "extruder" not in self._modes:
            self._refuse(
                "the program has not said M82 or M83", "write it after the last G90"
            )
        if relative and act.does in IN_PLANE:
            self._refuse(
                f"{act.name} by increments", "write G90 before arcs and cycles"
            )
        if act.does == "hole" and not line.named("XYZ"):
            self._refuse(f"{act.name} names no axis", "give the hole's X and Y")
        if act.does == "arc" and self.dialect == "grbl" and not line.named("XY"):
            self._refuse("grbl needs X or Y for an arc", "give its end")

        ends = dict(self._at)
        for axis in line.named("XYZE"):
            ends[axis] = line.number(axis) + (
                self._at[axis] if self._relative(axis) else 0.0
            )
        lines = [_text(act, line, {})]
        if line.named("XY") or act.does in IN_PLANE:
            lines = self._corrected(act, line, ends)
        self._at = ends
        for text in lines:
            read = re.sub(r"\(.*?\)|;.*|\s", "", text)
            if len(read) > MAX_WORDS or len(text) > MAX_LINE:
                self._refuse(
                    "the corrected line is too long", "shorten its words or comments"
                )
        return lines

    def _relative(self, axis: str) -> bool:
        by_m83 = axis == "E" and self._modes.get("extruder") == "M83"
        return by_m83 or self._modes["distance"] == "G91"

    def _corrected(
        self, act: Code, line: ProgramLine, ends: Mapping[str, float]
    ) -> list[str]:
        """Return the lines of a move in XY."""
        if self._frame_ended:
            self._refuse(
                "G28 has ended an offset that G92 may have set before the program",
                "home X and Y before the first move as well",
            )
        unit_m = M_PER_INCH if self._modes["unit"] == "G20" else M_PER_MM
        start_m, end_m = (complex(at["X"], at["Y"]) * unit_m for at in (self._at, ends))
        known_m = end_m if self._travels(act, line) else start_m + end_m
        if not cmath.isfinite(known_m):
            self._refuse(
                "the position before this line is not known",
                "write an absolute move of X and Y before it"
                + " with G0" * (not self.prints),
            )
        limit_m = (1 - OF_SAMPLES) * self._tolerance_m
        if act.does == "arc":
            centre_m = start_m + complex(line.number("I"), line.number("J")) * unit_m
            sense = -1 if act.name == "G2" else 1
            path_m = self._arc(start_m, end_m, centre_m, sense=sense)
            limit_m -= abs(abs(end_m - centre_m) - abs(start_m - centre_m))
        elif act.does == "line" and cmath.isfinite(start_m):
            count = self._count(abs(end_m - start_m), self._step_m)
            path_m = np.linspace(start_m, end_m, count)
        else:
            path_m = np.array([end_m, end_m])
        self._reach(path_m)

        commanded_m = path_m + np.dot((1, 1j), self._correct(path_m.real, path_m.imag))
        vertices = simplified(commanded_m, limit_m)[1:]
        shared = self._shared(line) if len(vertices) > 1 else {}
        lines: list[str] = []
        for i in vertices:
            place = {
                "X": commanded_m[i].real / unit_m,
                "Y": commanded_m[i].imag / unit_m,
            }
            for axis, start in shared.items():
                way = line.number(axis) - start
                place[axis] = start + way * i / (len(path_m) - 1)
            texts = {
                axis: self._coordinate(axis, value) for axis, value in place.items()
            }
            rest = ProgramLine([], {}, []) if lines else line
            lines.append(_text(act, rest, texts))
        self.moves += 1
        self.pieces += len(lines)
        return lines

    def _travels(self, act: Code, line: ProgramLine) -> bool:
        """Return whether only the end of a move matters, not its path."""
        extrudes_nothing = act.does == "line" and not line.named("E")
        on_a_printer = self.prints or (self._printer and act.name == "G0")
        return act.does in ("rapid", "hole") or (extrudes_nothing and on_a_printer)

    def _reach(self, path_m: np.ndarray) -> None:
        """Widen the field of the program by a path."""
        places_m = np.stack([path_m.real, path_m.imag], axis=1)
        self.reach_m[0] = np.minimum(self.reach_m[0], places_m.min(axis=0))
        self.reach_m[1] = np.maximum(self.reach_m[1], places_m.max(axis=0))
        self._drawn = True

    def _shared(self, line: ProgramLine) -> dict[str, float]:
        """Return where the other axes of a split move start, 0 if by increments."""
        for axis in line.named("ZE"):
            self._sent[axis] = 0.0 if self._relative(axis) else self._at[axis]
            if math.isnan(self._sent[axis]):
                self._refuse(
                    f"{axis} before this line is not known, and the move is split",
                    f"command {axis} alone first",
                )
        return {axis: self._sent[axis] for axis in line.named("ZE")}

    def _arc(
        self, start_m: complex, end_m: complex, centre_m: complex, *, sense: int
    ) -> np.ndarray:
        """Return points of an arc, m."""
        from_m, to_m = start_m - centre_m, end_m - centre_m
        if not from_m or not to_m:
            self._refuse(
                "the arc has no centre", "give I and J, or begin the line with G1"
            )
        sweep = sense * cmath.phase(to_m / from_m) % (2 * math.pi)
        unsure = not NO_TURN_RAD < sweep < 2 * math.pi - NO_TURN_RAD
        if start_m == end_m:
            sweep = 2 * math.pi
            unsure = False
        if unsure or abs(abs(to_m) - abs(from_m)) > self._tolerance_m / 2:
            self._refuse(
                f"the arc ends at {abs(to_m) / abs(from_m):.6f} times its radius, "
                f"after {math.degrees(sweep):.3f}°",
                "give more digits or a larger --tolerance; write what is as good as straight as G1",
            )
        sagitta = min(1.0, OF_SAMPLES * self._tolerance_m / abs(from_m))
        step = min(2 * math.acos(1 - sagitta), self._step_m / abs(from_m))
        share = np.linspace(0, 1, self._count(sweep, step))
        growth = 1 + (abs(to_m) / abs(from_m) - 1) * share
        path_m = centre_m + from_m * growth * np.exp(1j * sense * sweep * share)
        path_m[-1] = end_m
        return path_m

    def _count(self, length: float, step: float) -> int:
        """Return the number of points that divide a length into steps."""
        if length > MAX_SAMPLES * step:
            self._refuse("the move is too long for this tolerance", "give a larger one")
        return max(math.ceil(length / step), 1) + 1

    def _coordinate(self, axis: str, place: float) -> str:
        """Return a coordinate as text; increments are those of the rounded positions."""
        digits = self._decimals + (self._modes["unit"] == "G20") + (axis in "ZE")
        place = round(place, digits)
        before = self._sent[axis]
        self._sent[axis] = place
        value = round(place - before if self._relative(axis) else place, digits) + 0.0
        text = f"{value:.{digits}f}".rstrip("0")
        return text + "0" * text.endswith(".")


def _text(act: Code, line: ProgramLine, places: Mapping[str, str]) -> str:
    """Return a line: its number, command and coordinates, then all else."""
    number = [f"N{line.values[letter]}" for letter in line.named("N")]
    command = "G1" if act.does == "arc" else act.name
    axes = [letter + value for letter, value in places.items()]
    words = [
        letter + value
        for letter, value in line.values.items()
        if letter not in {"N", "I", "J", *places}
    ]
    codes = [code.name for code in line.codes if code is not act]
    return " ".join([*number, command, *axes, *words, *codes, *line.comments])


def simplified(path: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the indices of points between which motion at an even pace is within a tolerance."""
    keep = {0, len(path) - 1}
    waiting = [(0, len(path) - 1)]
    while waiting:
        i, j = waiting.pop()
        inner = np.arange(i + 1, j)
        even = path[i] + (inner - i) / (j - i) * (path[j] - path[i])
        off = np.abs(path[inner] - even)
        if off.max(initial=0.0) > tolerance:
            middle = int(inner[off.argmax()])
            keep.add(middle)
            waiting += [(i, middle), (middle, j)]
    return np.array(sorted(keep))
