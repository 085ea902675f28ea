# SPDX-License-Identifier: Apache-2.0
"""Mark detections of images: candidates, fits, reasons of rejection, offsets in stage axes."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial import KDTree

from selfcal_ros.collection.inputs import Detection, Kind
from selfcal_ros.errors import InputError
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.parameter import place_of
from selfcal_ros.vision.finding import Candidate, candidates
from selfcal_ros.vision.fitting import Fit, Windows, fit_marks, lie_inside, windows_of
from selfcal_ros.vision.images import Picture
from selfcal_ros.vision.models import MODELS
from selfcal_ros.vision.shown import alternates, spots_in

SMALLEST_SIZE, LARGEST_SIZE = 6.0, 2000.0
"""Range of the size of a mark, px."""
WIDTH = 0.2
"""Default width of lines over the size of the mark."""
STAINED = 3
"""Number of stained pixels from which a mark is rejected."""
SATURATED = 0.01
"""Part of saturated pixels from which a mark is rejected."""
SAME = 0.3
"""Distance of two fits, in sizes of the mark, below which they are of the same mark."""
SMALL = 10.0
"""Size of a mark, px, below which lens and pixels, not the focus, make its blur over its size:
marks of 6 to 10 px that are blurred by 1 to 1.5 px lie where their u says."""
FIRST_BLUR = 0.05
"""First blur of a fit, in sizes of the mark; at least a pixel."""


class MarkFault(StrEnum):
    """Why a possible mark is rejected."""

    CUT_OFF = "cut_off"
    SATURATED = "saturated"
    NO_FIT = "no_fit"
    DEFOCUSED = "defocused"
    WRONG_SIZE = "wrong_size"
    REFLECTION = "reflection"
    DIRT = "dirt"
    BROKEN = "broken"
    WEAK = "weak"
    DOUBLE = "double"
    MARKER = "part_of_a_marker"


REMEDIES: dict[str, str] = {
    MarkFault.SATURATED: "expose shorter, and take the images again",
    MarkFault.DEFOCUSED: "focus, and take the images again",
    MarkFault.WEAK: "expose longer or raise the contrast, and take the images again",
}
"""Reason for which most marks are rejected -> what to do, if other settings do not help.

Blurred marks look larger than they are.
"""


@dataclass(frozen=True)
class Mark:
    """A mark in an image.

    Attributes
    ----------
    u, v : float
        Column and row of its centre; 0 is the centre of the first pixel.
    u_u, u_v : float
        Their standard uncertainties, px.
    score : float
        Part of the variance of its window that the model explains, 0 to 1.
    fit : Fit
        The fit.
    """

    u: float
    v: float
    u_u: float
    u_v: float
    score: float
    fit: Fit


@dataclass(frozen=True)
class Judged:
    """A possible mark: where it was looked for, px, and the mark, or why there is none."""

    u: float
    v: float
    found: Mark | MarkFault


class MarkDetector:
    """Find the marks of images.

    Parameters
    ----------
    settings : DetectorSettings
        Values of the parameters of mark_detector.
    where : str
        Place of these for errors.

    Raises
    ------
    InputError
        If the size of the pixels or marks is not set, or marks are too small or large in pixels.
    """

    def __init__(
        self, settings: DetectorSettings, where: str = "mark_detector"
    ) -> None:
        unset = [
            name
            for name in ("pixel_size", "mark_size")
            if not getattr(settings, name) > 0
        ]
        if unset:
            verb, them = ("are", "them") if len(unset) > 1 else ("is", "it")
            raise InputError(
                place_of(where, *unset),
                f"{verb} not set",
                f"give {them} in m; `selfcal camera init` finds the size of a pixel",
            )
        self.settings, self._model = settings, MODELS[settings.mark]
        self.size = settings.mark_size / settings.pixel_size
        self._width = settings.mark_width / settings.pixel_size or WIDTH * self.size
        if not SMALLEST_SIZE <= self.size <= LARGEST_SIZE:
            raise InputError(
                place_of(where, "mark_size"),
                f"{self.size:.3g} pixels",
                f"a mark has {SMALLEST_SIZE:g} to {LARGEST_SIZE:g} pixels; correct it "
                "or the size of a pixel",
            )
        if 2 * self._width >= self.size and settings.mark in ("ring", "cross"):
            raise InputError(
                place_of(where, "mark_width"),
                "at least half of the size of a mark",
                "give the width of one line",
            )
        self._sign = (
            0
            if settings.mark == "corner"
            else 1
            if settings.polarity == "bright"
            else -1
        )

    def judged(self, picture: Picture) -> list[Judged]:
        """Return the possible marks of an image, row by row.

        Raises
        ------
        InputError
            If there are more possible marks than `max_marks`.
        """
        image = picture.values
        full = self.settings.full_scale or picture.full_scale
        possible = candidates(
            image,
            mark=self.settings.mark,
            size=self.size,
            width=self._width,
            sign=self._sign,
            most=self.settings.max_marks,
        )
        fitted = _without_doubles(self._fitted(image, possible, full), SAME * self.size)
        return [
            Judged(mark.u, mark.v, mark)
            if isinstance(mark, Mark)
            else Judged(candidate.column, candidate.row, mark)
            for candidate, mark in zip(possible, fitted, strict=True)
        ]

    def marks(self, picture: Picture) -> tuple[list[Mark], Counter[str]]:
        """Return the marks of an image, row by row, and the number of rejected ones by reason.

        Raises
        ------
        InputError
            As `judged`.
        """
        return told_apart(self.judged(picture))

    def _fitted(
        self, image: np.ndarray, possible: list[Candidate], full: int
    ) -> list[Mark | MarkFault]:
        """Return the mark at each candidate, or why there is none.

        Each is fitted again in a window centred on a first fit, so that nothing depends on the
        candidate.
        """
        if not possible:
            return []
        out: list[Mark | MarkFault] = [MarkFault.NO_FIT] * len(possible)
        columns, rows = (
            np.array([getattr(candidate, name) for candidate in possible], dtype=int)
            for name in ("column", "row")
        )
        blur = max(1.0, FIRST_BLUR * self.size)
        starts = np.array(
            [
                self._model.start(self.size, self._width, candidate.angle, blur)
                for candidate in possible
            ]
        )
        waiting = np.arange(len(possible))
        is_second = False
        while len(waiting):
            off_centre = []
            for index, fit in self._fits(image, (columns, rows), starts, waiting, full):
                if isinstance(fit, MarkFault):
                    out[index] = fit
                    continue
                du, dv = (round(float(away)) for away in fit.centre)
                if is_second or not (du or dv):
                    out[index] = self._mark(fit, int(columns[index]), int(rows[index]))
                    continue
                columns[index] += du
                rows[index] += dv
                starts[index] = list(fit.shape.values())
                off_centre.append(index)
            waiting = np.array(off_centre, dtype=int)
            is_second = True
        return out

    def _fits(
        self,
        image: np.ndarray,
        centres: tuple[np.ndarray, np.ndarray],
        starts: np.ndarray,
        which: np.ndarray,
        full: int,
    ) -> Iterator[tuple[int, Fit | MarkFault]]:
        """Yield the fit of each candidate in `which`, or why there is none."""
        columns, rows = centres[0][which], centres[1][which]
        radius = self._model.reach * self.size + 2
        inside = lie_inside(image, columns, rows, radius)
        for index in which[~inside]:
            yield int(index), MarkFault.CUT_OFF
        windows = windows_of(image, columns[inside], rows[inside], radius)
        saturated = (windows.values >= full).mean(axis=1) > SATURATED
        for index in which[inside][saturated]:
            yield int(index), MarkFault.SATURATED
        usable = which[inside][~saturated]
        fits = fit_marks(
            self._model,
            Windows(windows.disc, windows.values[~saturated]),
            starts[usable],
        )
        for index, fit in zip(usable, fits, strict=True):
            yield int(index), MarkFault.NO_FIT if fit is None else fit

    def _mark(self, fit: Fit, column: int, row: int) -> Mark | MarkFault:
        """Return the mark of a fit in the window at a pixel, or why it is rejected."""
        fault = self._fault(fit)
        if fault is not None:
            return fault
        u_u, u_v = fit.sigmas
        return Mark(
            u=column + float(fit.centre[0]),
            v=row + float(fit.centre[1]),
            u_u=u_u,
            u_v=u_v,
            score=min(max(fit.explained, 0.0), 1.0),
            fit=fit,
        )

    def _fault(self, fit: Fit) -> MarkFault | None:
        """Return why a fitted mark is rejected, or None."""
        settings = self.settings
        size = fit.shape.get("size", self.size)
        if self._sign * fit.contrast < 0:
            return MarkFault.NO_FIT
        if abs(fit.shape["blur"]) > settings.max_blur * max(self.size, SMALL):
            return MarkFault.DEFOCUSED
        if fit.bright + fit.dark + fit.inner_stains + fit.outer_stains >= STAINED:
            # these spoil the levels of the others
            if max(fit.bright, fit.dark) >= STAINED:
                return MarkFault.REFLECTION if fit.bright > fit.dark else MarkFault.DIRT
            return (
                MarkFault.BROKEN
                if fit.inner_stains > fit.outer_stains
                else MarkFault.DIRT
            )
        if abs(size / self.size - 1) > settings.size_tolerance:
            return MarkFault.WRONG_SIZE
        if not max(fit.sigmas) <= settings.max_sigma_px:
            return MarkFault.WEAK
        return None

    def nothing_found(
        self, picture: Picture | None, *, rejected: Counter[str], size_option: str
    ) -> tuple[str, str]:
        """Return what is wrong with images without a mark, and what to change.

        Parameters
        ----------
        picture : Picture or None
            One of them.
        rejected : Counter
            Reason -> possible marks that were rejected in all of them.
        size_option : str
            The option that states the size of a mark, in the unit of `pixel_size`.
        """
        settings = self.settings
        none_found = (
            f"no {'' if self._sign == 0 else settings.polarity + ' '}{settings.mark} of "
            f"{self.size:.3g} px was found"
        )
        summary = none_found + rejected_text(rejected)
        cut_off = rejected[MarkFault.CUT_OFF]
        inside = rejected - Counter({str(MarkFault.CUT_OFF): cut_off})
        most = next((reason for reason, _ in inside.most_common(1)), "")
        spots = None if picture is None else spots_in(picture.values)
        repeats = (
            "nothing repeats in them"
            if spots is None
            else f"what repeats is {spots.side_px:.3g} px, {spots.polarity}"
        )
        what = f"{summary}; {repeats}"
        if picture is not None and alternates(picture.values):
            return (
                what,
                "let the camera give grey or colour images, not a Bayer pattern",
            )
        if spots is None:
            return what, REMEDIES.get(
                most,
                "let whole marks lie in the image, half their size free around them; "
                "check exposure and focus"
                if cut_off and not inside
                else "check exposure and focus",
            )
        if most in REMEDIES:
            return what, REMEDIES[most]
        if spots.side_px < SMALLEST_SIZE:
            return what, f"magnify them: a mark has at least {SMALLEST_SIZE:g} pixels"
        options = []
        if abs(spots.side_px / self.size - 1) > settings.size_tolerance:
            options.append(f"{size_option} {spots.side_px * settings.pixel_size:.2g}")
        if self._sign and spots.polarity != settings.polarity:
            options.append(f"--polarity {spots.polarity}")
        return what, (
            f"try {' '.join(options)}"
            if options
            else "see where they are with selfcal detect --draw FOLDER; another --mark (disc, "
            "ring, cross, corner)?"
        )

    def detections(
        self,
        marks: Sequence[Mark],
        shape: tuple[int, ...],
        stamp_ns: int,
        ids: Sequence[tuple[int, int] | None] = (),
    ) -> list[Detection]:
        """Return the marks of an image of this shape (h, w) as detections, with ids if known."""
        out = []
        for mark, mark_id in zip(marks, ids or [None] * len(marks), strict=True):
            x, y = offset(mark.u, mark.v, shape, self.settings)
            sigma = self.settings.pixel_size * float(
                np.sqrt((mark.u_u**2 + mark.u_v**2) / 2)
            )
            m, n = mark_id or (0, 0)
            out.append(
                Detection(
                    stamp_ns,
                    int(Kind.GRID),
                    mark_id is not None,
                    m=m,
                    n=n,
                    k=0,
                    offset_x=x,
                    offset_y=y,
                    offset_theta=0.0,
                    sigma=sigma,
                    score=mark.score,
                )
            )
        return out


def told_apart(judged: Iterable[Judged]) -> tuple[list[Mark], Counter[str]]:
    """Return the marks, and the number of rejected ones by reason."""
    marks: list[Mark] = []
    faults: Counter[str] = Counter()
    for candidate in judged:
        if isinstance(candidate.found, Mark):
            marks.append(candidate.found)
        else:
            faults[str(candidate.found)] += 1
    return marks, faults


def rejected_text(rejected: Counter[str]) -> str:
    """Return the reasons of rejected marks after a semicolon; nothing if there are none."""
    reasons = ", ".join(f"{count} {name}" for name, count in rejected.most_common())
    return f"; rejected: {reasons}" if reasons else ""


def _without_doubles(
    marks: list[Mark | MarkFault], near: float
) -> list[Mark | MarkFault]:
    """Return the marks; one that lies nearer than `near` to an earlier one is a double, px."""
    places = np.array(
        [
            (mark.u, mark.v) if isinstance(mark, Mark) else (np.nan, np.nan)
            for mark in marks
        ]
    ).reshape(len(marks), 2)
    fitted = np.flatnonzero(np.isfinite(places[:, 0]))
    out = list(marks)
    if len(fitted) < 2:
        return out
    pairs = fitted[KDTree(places[fitted]).query_pairs(near, output_type="ndarray")]
    for first, second in sorted(
        map(tuple, np.sort(pairs, axis=1)), key=lambda pair: pair[::-1]
    ):
        if isinstance(out[first], Mark):
            out[second] = MarkFault.DOUBLE
    return out


def offset(
    u: float, v: float, shape: tuple[int, ...], settings: DetectorSettings
) -> tuple[float, float]:
    """Return the offset of a place in the image from the optical axis, stage axes, m.

    The axis is the centre of the image; rows run along -y before the turn.
    """
    right = u - (shape[1] - 1) / 2
    up = (shape[0] - 1) / 2 - v
    if settings.mirror:
        right = -right
    turn = np.deg2rad(settings.turn)
    cosine, sine = np.cos(turn), np.sin(turn)
    return (
        float(cosine * right - sine * up) * settings.pixel_size,
        float(sine * right + cosine * up) * settings.pixel_size,
    )
