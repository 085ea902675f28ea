# SPDX-License-Identifier: Apache-2.0
"""Key figures of a map, and of its comparison with a known truth; their format."""

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap, datum_modes, remove_modes, rms
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import (
    ARCSEC_PER_RAD,
    MM_PER_M,
    MRAD_PER_RAD,
    UM_PER_M,
    URAD_PER_RAD,
)

UNKNOWN = "–"
_NUMBER = re.compile(r"(> )?[−+-]?\d[\d.]*(e[+-]?\d+)?|–|∞")


def significant(value: float, digits: int = 3) -> str:
    """Return `value` with `digits` significant digits; scientific only far from 1.

    NaN and infinities, which mean unknown, become a dash.
    """
    if not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -4 <= exponent < 7:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_u(value: float, u: float, *, sign: str = "") -> str:
    """Return a value ± its uncertainty, this with two digits, and both with its decimals.

    Without a finite uncertainty it is the value alone. With `sign` ``+`` a value above 0 has one.
    """
    if not math.isfinite(u):
        return significant(value)
    decimals = decimals_for([u], 2) if u > 0 else 3
    return f"{value:{sign}.{decimals}f} ± {u:.{decimals}f}"


def um(value_m: float) -> str:
    """Return a length in µm with its unit, or ``not known``."""
    return (
        f"{significant(value_m * UM_PER_M)} µm"
        if math.isfinite(value_m)
        else "not known"
    )


def arcsec(value_rad: float) -> str:
    """Return an angle in arcseconds with its unit, or ``not known``."""
    if not math.isfinite(value_rad):
        return "not known"
    return f"{significant(value_rad * ARCSEC_PER_RAD)} arcsec"


def fixed(value: float, decimals: int) -> str:
    """Return `value` with `decimals` decimals, without a negative zero; NaN becomes a dash."""
    if not math.isfinite(value):
        return UNKNOWN
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0 else text


def decimals_for(values: Sequence[float], digits: int = 3) -> int:
    """Return the number of decimals that gives the largest value `digits` significant digits."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return 0
    return min(max(digits - 1 - math.floor(math.log10(largest)), 0), 9)


def fixed_column(values: Sequence[float], digits: int = 3) -> list[str]:
    """Return the values of a column with as many decimals as its largest value needs."""
    decimals = decimals_for(values, digits)
    return [fixed(value, decimals) for value in values]


def aligned_numbers(values: Sequence[float]) -> list[str]:
    """Return the values of a column with equal decimals that resolve even the smallest one.

    The largest has three significant digits, and up to three decimals are added until the
    smallest has two; values beyond are in scientific form.
    """
    sizes = [abs(v) for v in values if math.isfinite(v) and v != 0]
    if not sizes or max(sizes) >= 1e7 or max(sizes) < 1e-6:
        return [significant(v) for v in values]
    decimals_of_smallest = 1 - math.floor(math.log10(min(sizes)))
    base = decimals_for(values)
    decimals = min(max(base, decimals_of_smallest), base + 3)
    return [fixed(value, decimals) for value in values]


def counted(number: int, noun: str) -> str:
    """Return ``1 view``, ``4 views``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def p_text(p: float | None, digits: int = 2) -> str:
    """Return ``p = 0.72``; a probability too small for a float is not 0. None is unknown."""
    if p is None:
        return f"p = {UNKNOWN}"
    return f"p = {p:.{digits}g}" if p else "p < 1e-300"


def numeric_columns(table: Sequence[Sequence[str]]) -> list[bool]:
    """Return which columns of a table contain only numbers below the header."""
    return [
        all(_NUMBER.fullmatch(cell) for cell in column)
        for column in zip(*table[1:], strict=True)
    ]


def aligned(
    rows: Sequence[Sequence[str]], *, left: int = 1, indent: str = "  "
) -> list[str]:
    """Return `rows` as lines in columns; the first `left` columns flush left, the rest right."""
    if not rows:
        return []
    widths = [max(_columns(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            cell + _fill(cell, width) if i < left else _fill(cell, width) + cell
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append((indent + "  ".join(cells)).rstrip())
    return lines


def _columns(text: str) -> int:
    """Return the terminal columns of `text`: wide East Asian characters take two."""
    return sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


def _fill(cell: str, width: int) -> str:
    return " " * (width - _columns(cell))


@dataclass(frozen=True)
class MapFigures:
    """Key figures of an error map, SI units, NaN where unknown.

    Attributes
    ----------
    n_sites, n_known : int
        Sites of the field, and those whose error is known.
    max_error_m : float
        Longest error vector |G|.
    max_site : tuple of int or None
        Its site (m, n).
    rms_error_m, rms_u_m, max_u_m : float
        Error per axis, and standard uncertainty (k=1) per axis.
    n_lines, n_lines_known, max_theta_rad, max_line, rms_theta_rad, rms_u_theta_rad,
    max_u_theta_rad
        The same for the angular lines; `max_line` is k or None.
    """

    n_sites: int
    n_known: int
    max_error_m: float
    max_site: tuple[int, int] | None
    rms_error_m: float
    rms_u_m: float
    max_u_m: float
    n_lines: int
    n_lines_known: int
    max_theta_rad: float
    max_line: int | None
    rms_theta_rad: float
    rms_u_theta_rad: float
    max_u_theta_rad: float


@dataclass(frozen=True)
class TruthFigures:
    """Map minus truth without the datum difference, SI units, NaN where unknown.

    `largest_m` is the longest difference vector, `site` where, `rms_m` per axis. `rms_in_u`
    and `largest_in_u` are in units of the predicted standard uncertainty; `within_2u` is the
    share of values within 2 u. The `*_theta*` fields are the same for the angular lines.
    """

    largest_m: float
    site: tuple[int, int] | None
    rms_m: float
    rms_in_u: float
    largest_in_u: float
    within_2u: float
    largest_theta_rad: float = math.nan
    line: int | None = None
    rms_theta_rad: float = math.nan
    rms_theta_in_u: float = math.nan
    largest_theta_in_u: float = math.nan
    theta_within_2u: float = math.nan


def largest(values: np.ndarray) -> tuple[float, tuple[int, ...] | None]:
    """Return the largest magnitude among the finite values and its index; NaN, None if none."""
    sizes = np.abs(values)
    if not np.isfinite(sizes).any():
        return math.nan, None
    flat = int(np.nanargmax(np.where(np.isfinite(sizes), sizes, np.nan)))
    return float(sizes.flat[flat]), tuple(
        int(i) for i in np.unravel_index(flat, sizes.shape)
    )


def summary_numbers(result: CalibrationResult | None) -> dict[str, float]:
    """Return the numbers of a CalibrationSummary message by the names of its fields.

    Lengths in um, angles in arcsec, NaN where unknown, as all are without a result.
    ``max_error_um`` is the longest error vector |G|, ``rms_error_um`` and the uncertainties (k=1)
    are per axis; those with ``anywhere`` include the interpolation between the nodes.
    """
    if result is None:
        return dict.fromkeys(_SUMMARY_FIELDS, math.nan)
    u_rms, u_max, _ = anywhere_m(result)
    return {
        **summary_figures(result.error_map),
        "rms_uncertainty_anywhere_um": u_rms * UM_PER_M,
        "max_uncertainty_anywhere_um": u_max * UM_PER_M,
    }


def summary_figures(emap: ErrorMap) -> dict[str, float]:
    """Return the numbers of a CalibrationSummary that follow from its map alone."""
    figures = map_figures(emap)
    return {
        "max_error_um": figures.max_error_m * UM_PER_M,
        "rms_error_um": figures.rms_error_m * UM_PER_M,
        "rms_uncertainty_um": figures.rms_u_m * UM_PER_M,
        "max_theta_error_arcsec": figures.max_theta_rad * ARCSEC_PER_RAD,
        "rms_theta_uncertainty_arcsec": figures.rms_u_theta_rad * ARCSEC_PER_RAD,
    }


def anywhere_m(result: CalibrationResult) -> tuple[float, float, float]:
    """Return u rms, u at most and U at most of a coordinate anywhere in the field, m.

    NaN without an uncertainty map, and with damaged factors of its covariance.
    """
    from selfcal_ros.estimation.verdict.uncertainty import (
        budgets,
    )  # with scipy, not for figures

    try:
        result_budgets = budgets(result)
    except InputError:
        return (math.nan,) * 3
    for budget in result_budgets:
        if budget.quantity == "xy" and budget.anywhere:
            return budget.u_rms, budget.u_max, budget.U_max
    return (math.nan,) * 3


_SUMMARY_FIELDS = (
    "max_error_um",
    "rms_error_um",
    "rms_uncertainty_um",
    "max_theta_error_arcsec",
    "rms_theta_uncertainty_arcsec",
    "rms_uncertainty_anywhere_um",
    "max_uncertainty_anywhere_um",
)


def map_figures(emap: ErrorMap) -> MapFigures:
    """Return the figures of an error map; unknown sites and lines do not count."""
    valid = emap.valid
    g = np.stack([emap.gx, emap.gy])[:, valid]
    u = emap.u_xy[:, valid]
    max_error, index = largest(np.where(valid, np.hypot(emap.gx, emap.gy), np.nan))
    max_theta, line = largest(emap.g_theta)
    u_theta = emap.u_g_theta[np.isfinite(emap.g_theta)]
    return MapFigures(
        valid.size,
        int(valid.sum()),
        max_error,
        max_site=_site(emap, index),
        rms_error_m=rms(g),
        rms_u_m=rms(u),
        max_u_m=largest(u)[0],
        n_lines=emap.g_theta.size,
        n_lines_known=int(np.isfinite(emap.g_theta).sum()),
        max_theta_rad=max_theta,
        max_line=line[0] if line else None,
        rms_theta_rad=rms(emap.g_theta),
        rms_u_theta_rad=rms(u_theta),
        max_u_theta_rad=largest(u_theta)[0],
    )


def _site(emap: ErrorMap, index: tuple[int, ...] | None) -> tuple[int, int] | None:
    if index is None:
        return None
    m, n = emap.artifact.marks_at(*map(np.array, index))
    return int(m), int(n)


def truth_figures(emap: ErrorMap, truth: Mapping[str, np.ndarray]) -> TruthFigures:
    """Return the difference of `emap` and `truth`, after removing the datum difference.

    Translation, rotation and magnification of the difference (Hu eq. 5) and a constant angle
    cannot be seen in any view and are removed by least squares. The angles are weighted by 1/u², so
    that lines which the datum ties to the XY map (Hu eq. 9, small u) set the constant.

    Parameters
    ----------
    emap : ErrorMap
        The map found.
    truth : mapping
        ``gx``, ``gy`` (nx, ny) in m and, with angular lines, ``g_theta`` (K,) in rad.

    Raises
    ------
    InputError
        If an array is missing or of another shape.
    """
    artifact = emap.artifact
    true = truth_arrays(emap, truth) or {}
    difference = np.stack([emap.gx - true["gx"], emap.gy - true["gy"]])
    if np.isfinite(difference).all(axis=0).any():
        difference = remove_modes(difference, datum_modes(artifact, scale=True))
    difference[:, ~np.isfinite(difference).all(axis=0)] = np.nan
    longest, index = largest(np.hypot(*difference))
    xy = (
        longest,
        _site(emap, index),
        rms(difference),
        *_in_units(difference, emap.u_xy),
    )
    if "g_theta" not in true:
        return TruthFigures(*xy)
    theta = emap.g_theta - true["g_theta"]
    theta = theta - _common(theta, emap.u_g_theta)
    largest_theta, line = largest(theta)
    return TruthFigures(
        *xy,
        largest_theta,
        line[0] if line else None,
        rms(theta),
        *_in_units(theta, emap.u_g_theta),
    )


def _common(theta_rad: np.ndarray, u_rad: np.ndarray) -> float:
    """Return the constant of an angular difference: its mean, weighted where u is known."""
    finite = np.isfinite(theta_rad)
    weighted = finite & np.isfinite(u_rad) & (u_rad > 0)
    if weighted.any():
        smallest = u_rad[weighted].min()
        return float(
            np.average(theta_rad[weighted], weights=(smallest / u_rad[weighted]) ** 2)
        )
    return float(theta_rad[finite].mean()) if finite.any() else 0.0


def _in_units(difference: np.ndarray, u: np.ndarray) -> tuple[float, float, float]:
    """Return rms and largest of difference/u and the share within 2, where u is positive."""
    usable = np.isfinite(difference) & np.isfinite(u) & (u > 0)
    ratio = difference[usable] / u[usable]
    share = float(np.mean(np.abs(ratio) <= 2)) if ratio.size else math.nan
    return rms(ratio), largest(ratio)[0], share


def truth_arrays(
    emap: ErrorMap, truth: Mapping[str, np.ndarray] | None
) -> dict[str, np.ndarray] | None:
    """Return the truth as float arrays on the lattice of `emap`; None stays None.

    `g_theta` is left out where the plate has no angular lines or the truth does not hold it.

    Raises
    ------
    InputError
        If an array is missing or of another shape.
    """
    if truth is None:
        return None
    shape = emap.artifact.shape
    arrays = {key: _truth_array(truth, key, shape) for key in ("gx", "gy")}
    if emap.artifact.angular_count and truth.get("g_theta") is not None:
        arrays["g_theta"] = _truth_array(
            truth, "g_theta", (emap.artifact.angular_count,)
        )
    return arrays


def _truth_array(
    truth: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]
) -> np.ndarray:
    if key not in truth:
        raise InputError(f"truth {key}", "missing", "give gx, gy (m) and g_theta (rad)")
    try:
        array = np.array(truth[key], dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"truth {key}", "not an array of numbers", "give lists of numbers and null"
        ) from error
    if array.shape != shape:
        raise InputError(
            f"truth {key}",
            f"has the shape {array.shape}, the map has {shape}",
            "give the truth on the lattice of the map",
        )
    return array


PERCENT = 100
TURNS = 1e-3
"""p value below which a yaw of the stage is reported as significant."""


def camera_facts(result: CalibrationResult) -> tuple[tuple[str, str], ...]:
    """Return the camera's error shown by images, published minus true; empty without images."""
    camera = result.camera
    yaw = yaw_facts(result)
    if camera is None:
        return yaw
    cells = camera.known_cells

    def value_text(value: float, u: float, scale: float, unit: str) -> str:
        return f"{with_u(value * scale, u * scale)} {unit} (k=1)"

    worst = int(np.argmax(np.hypot(*cells[2:4])))
    x, y = cells[:2, worst] * MM_PER_M
    size = math.hypot(*cells[2:4, worst])
    u = math.hypot(*cells[4:6, worst]) / math.sqrt(2)
    distortions = [
        name
        for name, power in (("quadratic", (2, 0)), ("radial (cubic)", (2, 1)))
        if power in [coefficient.power for coefficient in camera.coefficients]
    ]
    return (
        (
            "scale",
            value_text(camera.scale, camera.u_scale, PERCENT, "%")
            + ", positive: published offsets too long",
        ),
        (
            "rotation",
            value_text(camera.rotation, camera.u_rotation, MRAD_PER_RAD, "mrad"),
        ),
        (
            "stretch, shear",
            f"{value_text(camera.stretch, camera.u_stretch, PERCENT, '%')}, "
            f"{value_text(camera.shear, camera.u_shear, PERCENT, '%')}",
        ),
        ("distortion", " and ".join(distortions) or "none shown"),
        (
            "largest error",
            f"{with_u(size * UM_PER_M, u * UM_PER_M)} µm at "
            f"x {x:.4g} mm, y {y:.4g} mm of the image",
        ),
        (
            "noise",
            f"{significant(camera.noise_image * UM_PER_M)} µm of an image, "
            f"{significant(camera.noise_mark * UM_PER_M)} µm of a mark in it",
        ),
        *yaw,
    )


def yaw_facts(result: CalibrationResult) -> tuple[tuple[str, str], ...]:
    """Return the yaw of the stage shown by images; empty without images."""
    yaw_map = result.stage_yaw
    if yaw_map is None:
        return ()
    low, high, mean_u = (
        significant(value * URAD_PER_RAD)
        for value in (
            yaw_map.yaw.min(),
            yaw_map.yaw.max(),
            math.sqrt(np.mean(yaw_map.u_yaw**2)),
        )
    )
    significance = (
        p_text(yaw_map.p, 1)
        if yaw_map.p < TURNS
        else f"not more than its noise, {p_text(yaw_map.p)}"
    )
    return (
        (
            "yaw of the stage",
            f"{low} to {high} ± {mean_u} µrad (k=1) about its mean; {significance}",
        ),
    )
