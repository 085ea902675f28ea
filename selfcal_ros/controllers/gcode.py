# SPDX-License-Identifier: Apache-2.0
"""Corrected G-code for controllers without tables: each point p is commanded as p + c(p).

Lines and arcs of the XY plane are split so that the corrected path stays within a chord tolerance.
What a code does is read from the list of its dialect. Every other code, word and character is
refused, and so is a move that needs a position or a mode that the program has not stated.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, NoReturn

import numpy as np

from selfcal_ros.compensation.residual import Correction
from selfcal_ros.controllers.gcode_codes import DIALECTS, PRINTERS, Code, remedy
from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER_INCH, M_PER_MM

VALUE, BLANK = r"(?P<value>[-+]?(?:\d+\.?\d*|\.\d+))", r"|[ \t]+"
TOKEN = re.compile(rf"\([^()]*\)|;.*|(?P<letter>[A-Za-z])[ \t]*{VALUE}{BLANK}", re.ASCII)
PRINTER_TOKEN = re.compile(rf";.*|(?P<letter>[A-Z]){VALUE}?{BLANK}", re.ASCII)
NAME = re.compile(r"\s*([A-Za-z_]{2,}\w*)")
MESSAGE = re.compile(r"\s*M11[78](?:[ \t]|$)")
FORBIDDEN = {"linuxcnc": r"[(;]\s*(?i:py|abort)", "grbl": r"[!?~]|[^\x00-\x7f]"}
"""Comments that run Python or stop; characters that are obeyed at once, even in comments."""
CONTROL = r"[\x00-\x08\x0a-\x1f\x7f]"
ALWAYS = "NFST"
"""Words that each line of a controller may have; a printer has one command in a line."""
MOVES = ("rapid", "line", "arc", "hole")
ACTS = (*MOVES, "cancel", "probe", "dwell", "home", "unknown", "tool length", "set E")
MODES = ("distance", "unit", "plane", "path", "frame", "offset", "extruder")
MUST_SAY = {"distance": ("G90 or G91", MOVES), "unit": ("G20 or G21", MOVES),
            "plane": ("G17", ("arc", "hole")), "path": ("G61, G61.1 or G64", ("line", "arc"))}
"""Modes without which a move is not understood; what to say; the moves."""
OF_SAMPLES = 1 / 8
"""Part of the chord tolerance for the distance of the points on which the path is judged."""
MAX_SAMPLES = 1_000_000
NO_TURN_RAD = 1e-4
"""Sweep of an arc that a controller may take for a full turn."""
MAX_WORDS, MAX_LINE, MAX_COMMENT = 79, 255, 200
"""Characters of a line that grbl reads without blanks and comments, LinuxCNC with them."""


class Word(NamedTuple):
    """A word of a line; letter "" for comments and blanks, value nan for a letter alone."""

    letter: str
    value: float
    text: str

    @property
    def name(self) -> str:
        """The word as the lists write it."""
        return f"{self.letter}{self.value:.10g}"


def corrected_program(text: str, where: str, rewriter: "Rewriter") -> str:
    """Return a program with corrected moves; InputError names a line that cannot be corrected."""
    out = []
    for number, line in enumerate(re.findall(r"[^\n]*\n|[^\n]+", text), 1):
        content = line.removesuffix("\n").removesuffix("\r")
        end = line[len(content):]
        out.append((end or "\n").join(rewriter.line(content, f"{where}:{number}")) + end)
    return "".join(out)


def commented(program: str, comments: Sequence[str]) -> str:
    """Return a program with comments as its first lines, after a %."""
    newline = "\r\n" if "\r\n" in program else "\n"
    begins = re.match(r"\s*%[^\n]*\n", program)
    head = begins[0] if begins else ""
    lines = ["; " + re.sub("[^ -~]|[!?~]", "_", text[:MAX_COMMENT]) + newline for text in comments]
    return head + "".join(lines) + program[len(head):]


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
    unit : str, optional
        "mm" or "in", if the program does not say it.
    decimals : int
        Of coordinates in mm; one more in inches.
    """

    def __init__(self, correct: Correction, *, dialect: str, tolerance_m: float, step_m: float,
                 unit: str | None = None, decimals: int = 5) -> None:
        self._correct, self._tolerance_m, self._step_m = correct, tolerance_m, step_m
        self.dialect, self._codes, self._decimals = dialect, DIALECTS[dialect], decimals
        self._printer = dialect in PRINTERS
        unit = "mm" if self._printer else unit
        self._said = {} if unit is None else {"unit": "G20" if unit == "in" else "G21"}
        self._motion: Code | None = None
        self._last_relative = False  # of G90, G91, M82 and M83
        self._at: dict[str, float] = {}  # in the program's unit; an axis is absent if not known
        self._sent = (math.nan, math.nan)  # X and Y as commanded
        self._begun = self._ended = self._drawn = False
        self._where = ""
        self.moves = self.pieces = 0
        self.reach_m = np.array([[math.inf] * 2, [-math.inf] * 2])
        """Least and largest x, y of the moves, m."""

    def line(self, text: str, where: str) -> list[str]:
        """Return the lines that replace a line; InputError if one cannot be corrected."""
        self._where = where
        words = self._words(text)
        values = self._values(words)
        codes = [self._code(word) for word in words if word.letter in ("G", "M")]
        act = self._act(codes, values)
        for code in codes:
            self._set(code)
        if "path" in {code.does for code in codes} and "Q" not in values:
            words = [word._replace(text=f"{word.text} Q0") if word.name == "G64" else word
                     for word in words]
        if act and act.does in MOVES:
            self._motion = act
            if {*"XYZE"} & {*values} or act.does in ("arc", "hole"):
                return self._moved(act, words, values, machine="G53" in {c.name for c in codes})
        elif act:
            self._do(act, values)
        return ["".join(word.text for word in words)]

    def _refuse(self, what: str, mend: str) -> NoReturn:
        raise InputError(self._where, what, mend)

    def _words(self, text: str) -> list[Word]:
        """Return the words, comments and blanks of a line."""
        wrong = re.search(f"{CONTROL}|{FORBIDDEN.get(self.dialect, CONTROL)}", text)
        if wrong:
            self._refuse(f"{wrong[0]!r} acts on {self.dialect} even in a comment", "remove it")
        begun, self._begun = self._begun, self._begun or bool(text.strip())
        if text.strip() == "%" and not self._printer:
            self._ended |= begun
            return [Word("", math.nan, text)]
        if self._printer and MESSAGE.match(text):
            return [Word("", math.nan, text)]
        name = NAME.match(text)
        if name:
            self._refuse(f"{name[1]} may move anything",
                         "write what it does in known codes, or run it before the program")
        token, at, words = PRINTER_TOKEN if self._printer else TOKEN, 0, []
        while at < len(text):
            match = token.match(text, at)
            if not match:
                self._refuse(f"'{text[at]}' does not belong to a word of {self.dialect}",
                             remedy(text[at].upper()))
            words.append(Word((match["letter"] or "").upper(), float(match["value"] or "nan"),
                              match[0]))
            at = match.end()
        if self._ended and any(word.letter for word in words):
            self._refuse("the line follows the end of the program", "remove it")
        return words

    def _values(self, words: Sequence[Word]) -> dict[str, float]:
        """Return the values of the words that are not codes."""
        letters = [word.letter for word in words if word.letter]
        values = {word.letter: word.value for word in words if word.letter not in ("", "G", "M")}
        for letter in values:
            if letters.count(letter) > 1:
                self._refuse(f"{letter} is given twice", "keep one of them")
        if self._printer and letters[:1] not in ([], ["G"], ["M"]):
            self._refuse("the line does not begin with a command", remedy(letters[0]))
        if "N" in letters[1:]:
            self._refuse("N does not begin the line", "move it there")
        if values.get("F", 1.0) <= 0:
            self._refuse("the feed is not positive", "give one")
        if values.get("Q") and any(word.name == "G64" for word in words):
            self._refuse("G64 Q merges the pieces of corrected lines", "write Q0")
        return values

    def _code(self, word: Word) -> Code:
        code = self._codes.get(word.name)
        if code is None or (self._printer and word.text != word.name):
            self._refuse(f"{word.text} is not in the list of codes that are known of "
                         f"{self.dialect}", remedy(word.name) if code is None else
                         f"write {word.name}")
        return code

    def _act(self, codes: Sequence[Code], values: Mapping[str, float]) -> Code | None:
        """Return the code by which a line acts, named or modal; refuse what does not belong."""
        acts = [code for code in codes if code.does in ACTS]
        kinds = [code.does for code in codes if code.does in MODES]
        moved = {*"XYZE"} & {*values}
        if len(acts) > 1 or len(kinds) > len({*kinds}) or (self._printer and len(codes) > 1):
            self._refuse(f"{' and '.join(code.name for code in codes)} in one line",
                         "write a line for each")
        if moved and not acts and self._motion and not self._printer:
            acts = [self._motion]
        said = list(dict.fromkeys([*codes, *acts]))
        if moved and not said:
            self._refuse("the line does not name its command", "begin it with one")
        words = "".join(code.words for code in said) + ALWAYS * (not self._printer)
        for letter, value in values.items():
            if words.count(letter) != 1:
                self._refuse(f"{letter} is not a word of "
                             f"{' '.join(code.name for code in said) or self.dialect}",
                             remedy(letter))
            if math.isnan(value) and acts and acts[0].does not in ("home", "unknown"):
                self._refuse(f"{letter} has no number", "give one")
        return acts[0] if acts else None

    def _set(self, code: Code) -> None:
        """Follow a mode."""
        if code.does in ("unit", "frame", "offset") and (
                self._said.get(code.does) != code.name or code.name == "G43"):
            if self._drawn:
                self._refuse(f"{code.name} follows a move in X or Y", remedy(code.name))
            self._at.clear()
        if code.does in MODES:
            self._said[code.does] = code.name
        if code.does in ("distance", "extruder"):
            self._last_relative = code.name in ("G91", "M83")
        if code.does == "unknown":
            self._at.clear()
        self._ended |= code.does == "end"

    def _do(self, act: Code, values: Mapping[str, float]) -> None:
        """Follow an act that is not a move."""
        if act.does in ("cancel", "probe"):
            self._motion = None
        if act.does == "home":
            stays = self._said.get("distance") == "G91" and not any(values.get(a) for a in "XY")
            if {"X", "Y"} & {*values} and not self._printer and not stays:
                self._refuse(f"{act.name} passes a point that is not corrected",
                             "write G91, and 0 for X and Y")
            self._at.clear()
        elif act.does in ("probe", "tool length"):
            self._at.pop("Z", None)
        elif act.does == "set E":
            if "E" not in values:
                self._refuse("G92 moves the frame", remedy("G92"))
            self._at["E"] = values["E"]

    def _relative(self, axis: str) -> bool | None:
        """Return whether an axis moves by increments; None if that depends on the firmware."""
        relative = self._said["distance"] == "G91"
        if axis == "E":
            relative |= self._said.get("extruder") == "M83"
            unsure = self.dialect == "marlin" and relative != self._last_relative
            return None if unsure or "extruder" not in self._said else relative
        return relative

    def _moved(self, act: Code, words: list[Word], values: Mapping[str, float], *,
               machine: bool) -> list[str]:
        """Return the lines of a move, each with its command."""
        for mode, (names, moves) in MUST_SAY.items():
            known = mode in self._said or mode not in {c.does for c in self._codes.values()}
            if act.does in moves and not known:
                self._refuse(f"the program has not said {names}", "write it before the first move")
        in_xy = bool({"X", "Y"} & {*values}) or act.does == "arc"
        if (machine and (in_xy or act.does not in ("rapid", "line"))) or (
                act.does in ("arc", "hole") and self._said.get("plane", "G17") != "G17") or (
                self._relative("X") and (act.does, self.dialect) in
                (("hole", "linuxcnc"), ("arc", "klipper"))):
            self._refuse(f"{act.name} is not a move in the XY plane of the map", "write G17 for "
                         "arcs, G90 for cycles, and Z alone with G53")
        ends = {axis: math.nan if self._relative(axis) is None else
                values[axis] + (self._at.get(axis, math.nan) if self._relative(axis) else 0.0)
                for axis in "XYZE" if axis in values}
        lines = self._corrected(act, words, ends) if in_xy else [_line(act, words, {})]
        if machine or act.does == "hole":
            ends["Z"] = math.nan
        self._at = {axis: at for axis, at in (self._at | ends).items() if math.isfinite(at)}
        if any(len(re.sub(r"\(.*?\)|;.*|\s", "", line)) > MAX_WORDS or len(line) > MAX_LINE
               for line in lines):
            self._refuse("the corrected line is too long", "shorten its words or comments")
        return lines

    def _corrected(self, act: Code, words: list[Word], ends: Mapping[str, float]) -> list[str]:
        """Return the lines of a move in XY."""
        values = {word.letter: word.value for word in words}
        unit_m = M_PER_INCH if self._said["unit"] == "G20" else M_PER_MM
        path, off_m = self._path(act, values, ends, unit_m)
        self.reach_m = np.array([np.minimum(self.reach_m[0], path.min(axis=0)),
                                 np.maximum(self.reach_m[1], path.max(axis=0))])
        path = path + np.stack(self._correct(path[:, 0], path[:, 1]), axis=1)
        kept = simplified(path, (1 - OF_SAMPLES) * self._tolerance_m - off_m)[1:]
        stops = [word for word in words if word.letter == "M"
                 and self._codes[word.name].does in ("stop", "end")]
        others = [word for word in words if word not in stops]
        lines: list[str] = []
        before, code = 0.0, self._codes["G1"] if act.does == "arc" else act
        for at in kept.tolist():
            share, texts = at / (len(path) - 1), self._coordinates((path[at] / unit_m).tolist())
            for axis in "ZE" if len(kept) > 1 else "":
                if axis in ends:
                    texts[axis] = self._shared(axis, values[axis], (before, share))
            lines.append(_line(code, [*others, *stops * (share == 1)], texts))
            others, before = [], share
        self._drawn, self.moves, self.pieces = True, self.moves + 1, self.pieces + len(lines)
        return lines

    def _path(self, act: Code, values: Mapping[str, float], ends: Mapping[str, float],
              unit_m: float) -> tuple[np.ndarray, float]:
        """Return points of the way, m, and how far a controller may be off them.

        Of a rapid, of a cycle, and of a printer's travel from an unknown place, the end alone.
        """
        start = [self._at.get(axis, math.nan) for axis in "XY"]
        end = [ends.get(axis, now) for axis, now in zip("XY", start, strict=True)]
        free = act.does in ("rapid", "hole") or (self._printer and act.does == "line"
                                                 and "E" not in ends)
        if not all(map(math.isfinite, end if free else [*start, *end])):
            self._refuse("the position before this line is not known", "write an absolute move of "
                         "X and Y before it" + " with G0" * (not self._printer))
        ends_m = np.array([start, end]) * unit_m
        if act.does == "arc":
            if self.dialect == "grbl" and not {"X", "Y"} & {*ends}:
                self._refuse("grbl needs X or Y for an arc", "give its end")
            return self._arc(act, ends_m, {a: values[a] * unit_m for a in "IJR" if a in values})
        if act.does == "line" and math.isfinite(start[0]):
            count = self._few(math.dist(*ends_m) / self._step_m)
            return np.linspace(ends_m[0], ends_m[1], count + 1), 0.0
        return ends_m[[1, 1]], 0.0

    def _arc(self, act: Code, ends_m: np.ndarray,
             values_m: Mapping[str, float]) -> tuple[np.ndarray, float]:
        """Return points of an arc, m, and how far a controller may be off them."""
        (start, end), sense = ends_m, -1 if act.name == "G2" else 1
        chord = end - start
        half = float(np.hypot(*chord)) / 2
        if values_m.keys() not in ({"R"}, {"I"}, {"J"}, {"I", "J"}):
            self._refuse("an arc needs R, or I and J", "give its centre, or begin the line with G1")
        if "R" in values_m:
            radius = values_m["R"]
            if not 0 < half <= abs(radius) * (1 + 1e-9):
                self._refuse("no arc of this radius joins its ends", "check R")
            height = math.sqrt(max(radius**2 - half**2, 0.0)) * math.copysign(1, radius) * sense
            middle = (start + end) / 2 + height * np.array([-chord[1], chord[0]]) / (2 * half)
        else:
            middle = start + np.array([values_m.get("I", 0.0), values_m.get("J", 0.0)])
        (r0, a0), (r1, a1) = ((float(np.hypot(*d)), math.atan2(d[1], d[0]))
                              for d in (start - middle, end - middle))
        sweep = sense * (a1 - a0) % (2 * math.pi) if half else 2 * math.pi
        if not r0 > 0 or abs(r1 - r0) > self._tolerance_m / 2 or (
                half and not NO_TURN_RAD < sweep < 2 * math.pi - NO_TURN_RAD):
            self._refuse(f"the ends of the arc are {r0 * 1e3:.6f} and {r1 * 1e3:.6f} mm from its "
                         f"centre, and it turns by {math.degrees(sweep):.3f} deg", "give more "
                         "digits or a larger --tolerance; write what is as good as straight as G1")
        limit = min(1.0, OF_SAMPLES * self._tolerance_m / r0)
        count = self._few(sweep / min(2 * math.acos(1 - limit), self._step_m / r0))
        t = np.linspace(0, 1, count + 1)
        radii, angles = r0 + (r1 - r0) * t, a0 + sense * sweep * t
        path = middle + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        path[0], path[-1] = start, end
        return path, abs(r1 - r0)

    def _few(self, count: float) -> int:
        if count > MAX_SAMPLES:
            self._refuse("the move is too long for this tolerance", "give a larger one")
        return max(math.ceil(count), 1)

    @property
    def _digits(self) -> int:
        return self._decimals + (self._said["unit"] == "G20")

    def _coordinates(self, point: Sequence[float]) -> dict[str, str]:
        """Return X and Y of a command as text; increments are those of the rounded positions."""
        now = (round(point[0], self._digits), round(point[1], self._digits))
        last, self._sent = self._sent if self._relative("X") else (0.0, 0.0), now
        return {axis: _text(value - old, self._digits)
                for axis, value, old in zip("XY", now, last, strict=True)}

    def _shared(self, axis: str, value: float, parts: tuple[float, float]) -> str:
        """Return another axis's word for the part of a move from and to these shares."""
        relative, start = self._relative(axis), self._at.get(axis, math.nan)
        if relative is None or not (relative or math.isfinite(start)):
            self._refuse(f"{axis} or its mode before this line is not known, and the move is split",
                         f"command {axis} alone first" if relative is not None else
                         "write M82 or M83 after the last G90 or G91")
        if not relative:
            return _text(start + (value - start) * parts[1], self._digits + 1)
        done, to_do = (round(value * part, self._digits + 1) for part in parts)
        return _text(to_do - done, self._digits + 1)


def _text(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}".rstrip("0")
    text += "0" * text.endswith(".")
    return "0.0" if float(text) == 0 else text


def _line(code: Code, words: Sequence[Word], texts: Mapping[str, str]) -> str:
    """Return a line: number, G codes, coordinates, then all else in its order."""
    axes = {**{word.letter: word.text[1:].strip() for word in words}, **texts}
    dropped = {*"NGXYZE"} if code.does == "hole" else {*"NGXYZEIJR"}
    first = [word.text for word in words if word.letter == "N" or (
        word.letter == "G" and word.name not in (code.name, "G2", "G3"))]
    last = [word.text for word in words if word.text.strip() and word.letter not in dropped]
    places = [axis + axes[axis] for axis in "XYZE" if axis in axes]
    return " ".join([*first, code.name, *places, *last])


def simplified(path: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Return the indices of points between which motion at an even pace is within a tolerance."""
    keep, waiting = {0, len(path) - 1}, [(0, len(path) - 1)]
    while waiting:
        i, j = waiting.pop()
        if j - i < 2:
            continue
        inner = np.arange(i + 1, j)
        even = path[i] + (inner - i)[:, None] / (j - i) * (path[j] - path[i])
        off = np.hypot(*(path[inner] - even).T)
        if off.max() > tolerance_m:
            middle = int(inner[off.argmax()])
            keep.add(middle)
            waiting += [(i, middle), (middle, j)]
    return np.array(sorted(keep))
