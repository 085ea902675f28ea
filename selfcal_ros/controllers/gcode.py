# SPDX-License-Identifier: Apache-2.0
"""Corrected G-code for controllers without tables: each point p is commanded as p + c(p).

Lines and arcs of the XY plane are split so that the corrected path stays within a chord tolerance.
All other words, comments and their order are kept. What would move the coordinates in a way that
the program does not show is refused.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from selfcal_ros.compensation.residual import Correction
from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER_INCH, M_PER_MM

TOKEN = re.compile(r"(?P<comment>\([^()]*\)|;.*)|(?P<word>(?P<letter>[A-Za-z])\s*(?P<value>"
                   r"[-+]?(?:\d+\.?\d*|\.\d+)))|(?P<space>\s+)|(?P<other>.)", re.ASCII)
VERBATIM = re.compile(r"\s*(?:%|\$|$|M11[78]\b)|\s*(?P<macro>[A-Za-z_]{2})", re.ASCII | re.I)
"""Lines without words: limits of a program, settings, messages, and macros."""
AXES = "XYZABCUVWE"
OTHERS = AXES[2:]
CYCLES = {"38.2", "38.3", "38.4", "38.5", "73", *map(str, range(81, 90))}
"""Motions of which only the end is corrected, as of G0."""
HOMING = {"28", "28.2", "29", "30"}
WORK = {"54", "55", "56", "57", "58", "59", "59.1", "59.2", "59.3"}
REFUSED = {"10": "moves the coordinates", "52": "moves the coordinates", "92": "moves the "
           "coordinates", "16": "uses polar coordinates", "51": "scales", "68": "turns",
           "41": "offsets the path by the tool", "42": "offsets the path by the tool",
           "93": "gives the feed as a time for each block", "53": "uses machine coordinates",
           "5": "is a spline", "5.1": "is a spline", "33": "is a thread", "76": "is a thread",
           "7": "uses diameters", "54.1": "moves the coordinates", "65": "calls a macro",
           "66": "calls a macro", "12": "is a pocket", "13": "is a pocket",
           "70": "means inches or something else", "71": "means mm or something else",
           "7.1": "wraps the plane round a cylinder", "12.1": "uses polar coordinates",
           "112": "uses polar coordinates"}
KNOWN = {"0", "1", "2", "3", "4", "9", "17", "18", "19", "20", "21", "40", "43", "43.1", "49", "50",
         "53", "61", "61.1", "64", "69", "80", "90", "90.1", "91", "91.1", "92", "94", "95", "96",
         "97", "98", "99", *CYCLES, *HOMING, *WORK}
"""Words beside which X and Y are known to be positions."""
LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+")
AT_END = {"0", "1", "2", "30", "60"}
"""M words that act once the motion has ended."""
OF_SAMPLES = 1 / 8
"""Part of the chord tolerance for the distance of the points on which the path is judged."""
MAX_SAMPLES = 1_000_000
LONGEST = 200
"""Characters of a comment: LinuxCNC refuses lines of 256."""


class Word(NamedTuple):
    """A word of a line, with its text; letter "" for comments and blanks."""

    letter: str
    code: str
    text: str


class Corrected(NamedTuple):
    """A corrected program, the number of its moves in XY, and of the moves that replace them."""

    text: str
    moves: int
    pieces: int


def corrected_program(text: str, where: str, rewriter: "Rewriter") -> Corrected:
    """Return a program with corrected moves.

    Raises
    ------
    InputError
        For a line that cannot be corrected.
    """
    out, newline = [], _newline(text)
    for number, line in enumerate(LINE.findall(text), 1):
        content = line.rstrip("\r\n")
        made = rewriter.line(content, f"{where}:{number}")
        out.append(newline.join(made) + line[len(content):])
    return Corrected("".join(out), rewriter.moves, rewriter.pieces)


def _newline(text: str) -> str:
    """Return the first end of a line in a text."""
    found = re.search(r"\r\n|\r|\n", text)
    return found[0] if found else "\n"


def commented(program: str, comments: Sequence[str]) -> str:
    """Return a program with comments as its first lines, after a % and the program's number.

    Between parentheses if the program has such comments, as not all controllers know both forms.
    """
    form = "({})" if "(" in re.sub(";.*", "", program) else "; {}"
    newline = _newline(program)
    text = "".join(form.format(re.sub(r"[^ -~]|[()]", "_", line[:LONGEST])) + newline
                   for line in comments)
    head = re.match(r"(?:\s*%[^\r\n]*[\r\n]+)?(?:[ \t]*O\d[^\r\n]*[\r\n]+)?", program,
                    re.I | re.ASCII)
    at = head.end() if head else 0
    return program[:at] + text + program[at:]


class Rewriter:
    """The modal state of a program, and its corrected lines.

    Parameters
    ----------
    correct : Correction
        Correction of positions x, y; both in m.
    tolerance_m : float
        Largest distance of the corrected path from the commanded one.
    step_m : float
        Largest distance of points at which the correction is looked up on a line.
    unit : str
        "mm" or "in", until G20 or G21.
    decimals : int
        Of coordinates in mm; one more in inches.
    """

    def __init__(self, correct: Correction, *, tolerance_m: float, step_m: float,
                 unit: str = "mm", decimals: int = 5) -> None:
        self._correct, self._tolerance_m, self._step_m = correct, tolerance_m, step_m
        self._decimals = decimals
        self._inch, self._absolute, self._centre_absolute = unit == "in", True, False
        self._motion, self._plane, self._work = "", "17", ""
        self._e_absolute: bool | None = None  # as the other axes, until M82 or M83
        self._at: dict[str, float] = {}  # x and y in m, others as programmed
        self._sent: tuple[float, float] | None = None  # as commanded, in program units
        self.moves = self.pieces = 0

    @property
    def _unit_m(self) -> float:
        return M_PER_INCH if self._inch else M_PER_MM

    def line(self, text: str, where: str) -> list[str]:
        """Return the lines that replace a line."""
        verbatim = VERBATIM.match(text)
        if verbatim:
            if verbatim["macro"]:
                self._forget()
            return [text]
        words = self._words(text, where)
        values = {w.letter: float(w.code) for w in words if w.letter not in ("", "G", "M")}
        codes = [w.code for w in words if w.letter == "G"]
        self._refuse(codes, values, where)
        for code in codes:
            self._set(code)
        self._set_extruder({w.code for w in words if w.letter == "M"})
        if HOMING & set(codes):
            if {"X", "Y"} & set(values) or not set(AXES) & set(values):
                self._forget()
            return [text]
        if {"4", "92"} & set(codes):
            self._at |= {a: values[a] for a in OTHERS if a in values and "92" in codes}
            return [text]
        arc = self._motion in ("2", "3")
        if not set("XY" if not arc else AXES + "IJR") & set(values):
            self._at |= self._ends(values)
            return ["".join(_as_line(w).text for w in words)] if arc else [text]
        return self._moved(words, values, where)

    def _words(self, text: str, where: str) -> list[Word]:
        found: list[Word] = []
        for match in TOKEN.finditer(text):
            if match["other"] and not (match["other"] == "/" and not "".join(
                    w.text for w in found).strip()):
                raise InputError(where, f"'{match['other']}' is not part of a word",
                                 "parameters, expressions and sub-programs cannot be corrected: "
                                 "post-process to plain words")
            letter = (match["letter"] or "").upper()
            code = match["value"] or ""
            if letter in ("G", "M"):
                code = f"{float(code):g}"
            found.append(Word(letter, code, match[0]))
        axes = [w.letter for w in found if w.letter in (*AXES, *"IJKR")]
        if len(axes) != len(set(axes)):
            raise InputError(where, "a coordinate is given twice", "keep one of them")
        return found

    def _refuse(self, codes: list[str], values: dict, where: str) -> None:
        for code in codes:
            why = REFUSED.get(code, "")
            if code in ("53", "92") and not {"X", "Y"} & set(values):
                why = ""
            if code in WORK and self._work not in ("", code):
                why = "changes the origin, whose place is not known"
            if not why and code not in KNOWN and {"X", "Y"} & set(values):
                why = "is not known, and may mean something else by X and Y"
            if why:
                raise InputError(where, f"G{code} {why}", "correct the program without it")

    def _set(self, code: str) -> None:
        """Follow a modal G word."""
        if code in ("20", "21") and (code == "20") != self._inch:
            self._inch, self._sent = code == "20", None
            self._at = {axis: self._at[axis] for axis in "XY" if axis in self._at}
        elif code in ("90", "91"):
            self._absolute = code == "90"
        elif code in ("90.1", "91.1"):
            self._centre_absolute = code == "90.1"
        elif code in ("17", "18", "19"):
            self._plane = code
        elif code in WORK:
            self._work = code
        elif code in ("0", "1", "2", "3", "80", *CYCLES):
            self._motion = code

    def _set_extruder(self, codes: set[str]) -> None:
        if {"82", "83"} & codes:
            self._e_absolute = "82" in codes
        if "98" in codes:  # a sub-program
            self._forget()

    def _forget(self) -> None:
        self._at, self._sent = {}, None

    def _is_absolute(self, axis: str) -> bool:
        return self._absolute if axis != "E" or self._e_absolute is None else self._e_absolute

    def _ends(self, values: dict[str, float]) -> dict[str, float]:
        """Return where the other axes end; those that are not known are left out."""
        out = {}
        for axis in OTHERS:
            absolute = self._is_absolute(axis)
            if axis in values and (absolute or axis in self._at):
                out[axis] = values[axis] + (0.0 if absolute else self._at[axis])
        return out

    def _moved(self, words: list[Word], values: dict[str, float], where: str) -> list[str]:
        """Return the lines of a move in XY."""
        start = tuple(self._at.get(axis, math.nan) for axis in "XY")
        end = []
        for axis, now in zip("XY", start, strict=True):
            value = values.get(axis, 0.0) * self._unit_m
            end.append(value if axis in values and self._absolute else now + value)
        if self._motion in CYCLES and values.get("L", 1.0) != 1.0:
            raise InputError(where, "a cycle is repeated", "write each hole in a line of its own")
        if not all(map(math.isfinite, end)) or not (self._absolute or self._sent):
            raise InputError(where, "the position before this line is not known",
                             "begin with an absolute move of X and Y")
        path = self._path((start[0], start[1]), (end[0], end[1]), values, where)
        cx, cy = self._correct(path[:, 0], path[:, 1])
        path = path + np.stack([cx, cy], axis=1)
        kept = simplified(path, (1 - OF_SAMPLES) * self._tolerance_m)[1:]
        share = kept / (len(path) - 1)
        lines = self._lines(words, values, path[kept] / self._unit_m, share, where)
        self._at |= {"X": end[0], "Y": end[1]} | self._ends(values)
        if self._motion.startswith("38"):  # a probe may stop before its end
            self._forget()
        self.moves += 1
        self.pieces += len(lines)
        return lines

    def _path(self, start: tuple[float, float], end: tuple[float, float],
              values: dict[str, float], where: str) -> np.ndarray:
        """Return points of the programmed path, (P, 2); of a rapid the end alone."""
        if self._motion in ("2", "3"):
            return self._arc(np.array(start), np.array(end), values, where)
        if self._motion == "1" and math.isfinite(start[0]):
            count = math.ceil(math.dist(start, end) / self._step_m)
            return np.linspace(start, end, _few(count, where) + 1)
        return np.array([end, end])

    def _arc(self, start: np.ndarray, end: np.ndarray, values: dict[str, float],
             where: str) -> np.ndarray:
        if self._plane != "17" or "P" in values or not np.isfinite(start).all():
            raise InputError(where, "the arc is not one turn in the XY plane from a known point",
                             "correct the program without it")
        unit, sense = self._unit_m, -1 if self._motion == "2" else 1
        given = set("IJR") & set(values)
        if not given or (self._centre_absolute and given in ({"I"}, {"J"})):
            raise InputError(where, "G90.1 needs I and J" if given else "the arc has no I, J or R",
                             "give its centre, or begin a line with G1")
        if "R" in values:
            chord, radius = end - start, values["R"] * unit
            half = float(np.hypot(*chord)) / 2
            if not 0 < half <= abs(radius) * (1 + 1e-6):
                raise InputError(where, "no arc of this radius joins its ends", "check R")
            height = math.sqrt(max(radius**2 - half**2, 0.0)) * math.copysign(1, radius) * sense
            middle = (start + end) / 2 + height * np.array([-chord[1], chord[0]]) / (2 * half)
        else:
            middle = np.array([values.get("I", 0.0), values.get("J", 0.0)]) * unit
            middle = middle if self._centre_absolute else start + middle
        (r0, a0), (r1, a1) = ((float(np.hypot(*d)), math.atan2(d[1], d[0]))
                              for d in (start - middle, end - middle))
        if not r0 > 0 or abs(r1 - r0) > max(5e-6, 1e-3 * r0):
            raise InputError(where, "the ends of the arc are not equally far from its centre",
                             "check I, J, X, Y")
        sweep = sense * ((sense * (a1 - a0)) % (2 * math.pi))
        if abs(sweep) < 1e-9:
            sweep = sense * 2 * math.pi
        limit = min(1.0, OF_SAMPLES * self._tolerance_m / r0)
        count = abs(sweep) / min(2 * math.acos(1 - limit), self._step_m / r0)
        t = np.linspace(0, 1, _few(math.ceil(count), where) + 1)
        radius_at, angle = r0 + (r1 - r0) * t, a0 + sweep * t
        path = middle + radius_at[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        path[0], path[-1] = start, end
        return path

    def _lines(self, words: list[Word], values: dict[str, float], points: np.ndarray,
               share: np.ndarray, where: str) -> list[str]:
        """Return a line for each piece; the first keeps the words of the original one."""
        arc, one = self._motion in ("2", "3"), len(points) == 1
        ends = self._ends(values)
        late = [] if one else [w for w in words if w.letter == "M" and w.code in AT_END]
        lines, before = [], 0.0
        for number, (point, part) in enumerate(zip(points.tolist(), share.tolist(), strict=True)):
            texts = self._coordinates(point, where)
            for axis in OTHERS if not one else "":
                if axis in values:
                    texts[axis] = self._shared(axis, values, ends, (before, part), where)
            if number == 0:
                lines.append(_line([w for w in words if w not in late], texts, arc=arc))
            else:
                lines.append(" ".join(axis + text for axis, text in texts.items()))
            before = part
        return [*lines[:-1], " ".join([lines[-1], *(w.text for w in late)])]

    def _coordinates(self, point: list[float], where: str) -> dict[str, str]:
        """Return X and Y of a command as text; increments are those of the rounded positions."""
        digits = self._decimals + self._inch
        now = (round(point[0], digits), round(point[1], digits))
        last, self._sent = self._sent, now
        if self._absolute:
            return {axis: _text(value, digits) for axis, value in zip("XY", now, strict=True)}
        if last is None:
            raise InputError(where, "the position before this line is not known",
                             "begin with an absolute move of X and Y")
        return {axis: _text(value - old, digits)
                for axis, value, old in zip("XY", now, last, strict=True)}

    def _shared(self, axis: str, values: dict[str, float], ends: dict[str, float],
                parts: tuple[float, float], where: str) -> str:
        """Return another axis's word for the part of a move from and to these shares."""
        digits = self._decimals + self._inch + 1
        if not self._is_absolute(axis):
            done, to_do = (round(values[axis] * part, digits) for part in parts)
            return _text(to_do - done, digits)
        if axis not in self._at:
            raise InputError(where, f"{axis} before this line is not known, and the move is split",
                             f"command {axis} alone first")
        start = self._at[axis]
        return _text(start + (ends[axis] - start) * parts[1], digits)


def _few(count: int, where: str) -> int:
    if count > MAX_SAMPLES:
        raise InputError(where, "the move is too long for this tolerance", "give a larger one")
    return max(count, 1)


def _text(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}".rstrip("0")
    text += "0" * text.endswith(".")
    return "0.0" if float(text) == 0 else text


def _as_line(word: Word) -> Word:
    """Return G1 for G2 and G3: arcs become lines."""
    is_arc = word.letter == "G" and word.code in ("2", "3")
    return Word("G", "1", "G1") if is_arc else word


def _line(words: list[Word], texts: dict[str, str], *, arc: bool) -> str:
    """Return a line with other coordinates, the missing ones after the last of them."""
    dropped = "IJKR" if arc else ""
    kept = [_as_line(w) for w in words if not w.letter or w.letter not in dropped]
    there = {w.letter for w in kept}
    blank = " " * any(not w.letter and not w.text.strip() for w in words)
    missing = "".join(f"{blank}{axis}{text}" for axis, text in texts.items() if axis not in there)
    last = max((n for n, w in enumerate(kept) if w.letter in AXES and w.letter),
               default=max(n for n, w in enumerate(kept) if w.letter))
    out = ""
    for number, word in enumerate(kept):
        out += word.letter + texts[word.letter] if word.letter in texts else word.text
        out += missing if number == last else ""
    return out.rstrip()


def simplified(path: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Return the indices of points whose polygon has all points within a tolerance (Douglas)."""
    keep, waiting = {0, len(path) - 1}, [(0, len(path) - 1)]
    while waiting:
        i, j = waiting.pop()
        if j - i < 2:
            continue
        chord, inner = path[j] - path[i], path[i + 1:j] - path[i]
        length2 = float(chord @ chord)
        along = np.clip(inner @ chord / length2, 0, 1) if length2 > 0 else np.zeros(len(inner))
        off = np.hypot(*(inner - along[:, None] * chord).T)
        worst = int(off.argmax())
        if off[worst] > tolerance_m:
            middle = i + 1 + worst
            keep.add(middle)
            waiting += [(i, middle), (middle, j)]
    return np.array(sorted(keep))
