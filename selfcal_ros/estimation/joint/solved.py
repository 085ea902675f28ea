# SPDX-License-Identifier: Apache-2.0
"""A solution before it is judged, and the parts of a fit that RESULT.json keeps.

Residuals, so that a report can show them without the bag; and the part of the map's covariance
that terms of the model make. With factors L (r, 2, nx, ny), cov(G) = sigma^2 (S + sum_r L_r L_r'),
where S follows from the weights of the readings, so that saved maps are compared exactly. Each
factor belongs to a term with a size, being what the map would gain if that term were known, or to
the free terms together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import NoiseEstimate
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.estimation.terms.equations import FREE, roots_by_term
from selfcal_ros.model.readings import GridVisits, Measurements, Sense
from selfcal_ros.model.result import CalibrationResult, Noise
from selfcal_ros.units import NS_PER_S


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution before any test.

    Attributes
    ----------
    result : CalibrationResult
        Maps with their uncertainties.
    xy, theta : NoiseEstimate
        Noise of the grid and of the angular readings.
    model : ModelFit, optional
        The joint fit; None for Hu's law.
    axes : tuple of float
        Probability and size (rad) of the misclosure of the axis conditions; 1 and 0 if not
        used.
    converged : bool
        Whether the estimate converged with the assumed terms.
    """

    result: CalibrationResult
    xy: NoiseEstimate
    theta: NoiseEstimate
    model: ModelFit | None = None
    axes: tuple[float, float] = (1.0, 0.0)
    converged: bool = True

    @property
    def joint(self) -> ModelFit:
        """The joint fit, of a solution that has one.

        Raises
        ------
        ValueError
            For Hu's law.
        """
        if self.model is None:
            raise ValueError("the solution has no joint fit")
        return self.model


def noise_of(xy: NoiseEstimate, theta: NoiseEstimate) -> Noise:
    """Return the noises of a result."""
    return Noise(
        xy.sigma, theta.sigma, xy.repeats, theta.repeats, xy.residuals, theta.residuals,
        xy.dof_repeats, theta.dof_repeats, xy.dof_residuals, theta.dof_residuals, xy.declared,
        theta.declared, xy.dof, theta.dof, xy.k, theta.k, xy.p, theta.p)


RESIDUALS = "residuals"
"""Key among the extras of a result."""

MAX_READINGS = 60_000
"""Largest number of grid readings with stored residuals: 121 x 121 marks in four views."""

MAX_PARTS = 60
"""Number of intervals of a view's time with a stored mean residual."""

DECIMALS_M, DECIMALS_RAD, DECIMALS_S = 13, 12, 3
"""Decimals stored: 0.1 pm, 1 prad, 1 ms."""


def kept_residuals(measurements: Measurements, model: ModelFit) -> dict[str, Any]:
    """Return the residuals of all readings for `CalibrationResult.extra`; empty for large fields.

    Each view has `dx`, `dy` [i][j] (m, stage axes, mark m = i - h, n = j - h of the plate) and
    `dtheta` [k] (rad, counter-clockwise), NaN where not read; and, if the visits of its marks
    are known, `course`: `time_s` (from the first visit of the run), mean `dx`, `dy` (m) and
    `count` of the readings in each interval of the view's time.

    Parameters
    ----------
    measurements : Measurements
        The readings.
    model : ModelFit
        The solution, with its residuals in the plate frame.
    """
    problem, found = model.problem, model.found
    if problem.system.grid.n_readings > MAX_READINGS:
        return {}
    starts = [int(v.visits.stamp_ns.min()) for v in measurements.views
              if v.visits is not None and len(v.visits.stamp_ns)]
    views, at_visits = [], {
        row: (rest + found.residuals[row].reshape(-1)[visits.mark]) * problem.to_stage[row]
        for row, visits, rest in model.visits_about_means()}
    for index, view in enumerate(measurements.views):
        entry: dict[str, Any] = {"view": view.view.name}
        if index in problem.grid.index:
            row = problem.grid.index.index(index)
            read = problem.grid.weight[row] > 0
            rest = np.where(read, found.residuals[row], np.nan) * problem.to_stage[row]
            entry |= {"dx": np.round(rest.real, DECIMALS_M), "dy": np.round(rest.imag, DECIMALS_M)}
            if starts and view.visits is not None and len(view.visits.mark):
                entry["course"] = _course(view.visits, at_visits[row], min(starts))
        if index in problem.angular.index:
            row = problem.angular.index.index(index)
            rest = np.where(problem.angular.weight[row] > 0, found.residuals_theta[row], np.nan)
            entry["dtheta"] = np.round(rest, DECIMALS_RAD)
        views.append(entry)
    return {RESIDUALS: {"views": views}}


def _course(visits: GridVisits, rest: np.ndarray, start_ns: int) -> dict[str, np.ndarray]:
    """Return the mean residual in each of `MAX_PARTS` intervals of the view's time.

    Or of each visit, if there are fewer.
    """
    order = np.argsort(visits.stamp_ns, kind="stable")
    parts = np.array_split(np.arange(len(order)), min(len(order), MAX_PARTS))
    starts = np.array([part[0] for part in parts])
    counts = visits.count[order]
    count = np.add.reduceat(counts, starts)
    since_s = (visits.stamp_ns - start_ns) / NS_PER_S
    columns = {name: np.add.reduceat(values[order] * counts, starts) / count
               for name, values in (("time_s", since_s), ("dx", rest.real), ("dy", rest.imag))}
    return {"time_s": np.round(columns["time_s"], DECIMALS_S),
            "dx": np.round(columns["dx"], DECIMALS_M), "dy": np.round(columns["dy"], DECIMALS_M),
            "count": count}


KEY = "covariance_terms"
"""Key of the factors in a result."""

MAX_FULL = 31 * 31
"""Largest field for a full covariance matrix."""

BESIDE = "beside"
"""Key of what each factor makes of other quantities: `plate` (r, 2, nx, ny), as those of the map;
`lines` (r, 2, K), the angular maps of stage and plate, and `microscope` (r, 4), its coefficients,
both times the longer half width of the plate. The first `with_map` belong to the factors of the
map, the others leave the map as it is."""

MICROSCOPE_PARTS = ("scale", "turn", "stretch", "shear")
"""Coefficients of a microscope in their order."""

OF_OFFSETS = "microscope"
"""Key of what factors make of them."""

NEGLIGIBLE = 1e-3
"""Length of a factor, in units of the noise, that changes no uncertainty by a thousandth."""

ANGULAR_KEY = "angular_terms"
"""Key of each term's contribution to the standard uncertainty of the angular map, rad."""

DIGITS = 7
"""Digits of a factor stored."""

LEAST = 1e-12
"""Entries of a factor below this are dropped, in units of the noise."""


def saved_terms(cover: MapsCovariance, columns: TermColumns, sense: Sense,
                beside: dict[str, np.ndarray] | None = None) -> dict[str, Any]:
    """Return the factors for `CalibrationResult.extra`; empty without terms, or for large fields.

    Parameters
    ----------
    cover : MapsCovariance
        Of the map, in the frame of the equations, terms included.
    columns : TermColumns
        The terms.
    sense : Sense
        What moved: the factors are in the stage frame.
    beside : dict of float array (p, ...), optional
        What a unit of each coefficient makes of other quantities, stage frame; see `BESIDE`.
    """
    shape, beside = cover.system.grid.views.shape, beside or {}
    if cover.system.grid.n_sites > MAX_FULL:
        return {}
    maps = cover.maps_of_terms()[0]
    maps = maps.reshape(*shape, maps.shape[1])
    sign = 1
    if sense is Sense.PLATE_MOVES:  # G(X) = -H(-X), and L L' is the same for -L
        maps, sign = maps[::-1, ::-1], -1
    both = np.concatenate([maps.real.reshape(-1, maps.shape[2]),
                           maps.imag.reshape(-1, maps.shape[2])])
    others = np.concatenate([np.zeros((0, maps.shape[2])), *(
        values.reshape(len(values), -1).T for values in beside.values())])
    factors, names, moved, alone = [], [], [], []
    for name, root in roots_by_term(cover.terms.covariance, columns):
        left, size, right = np.linalg.svd(both @ root, full_matrices=False)
        kept = size > NEGLIGIBLE
        factors += list((left[:, kept] * size[kept]).T.reshape(-1, 2, *shape))
        names += [name] * int(kept.sum())
        shown = right[kept].T @ right[kept]
        moved += list((others @ root @ right[kept].T).T)
        left, size, _ = np.linalg.svd(others @ (root - root @ shown), full_matrices=False)
        alone += list((left * size).T[size > NEGLIGIBLE])
    found = {"terms": names, "factors": rounded(np.array(factors)).tolist()}
    if beside:
        all_of = sign * np.array([*moved, *alone]).reshape(-1, len(others))
        ends = np.cumsum([values[0].size for values in beside.values()])[:-1]
        found[BESIDE] = {"with_map": len(names)} | {
            name: rounded(part.reshape(len(part), *values.shape[1:])).tolist()
            for (name, values), part in zip(beside.items(), np.split(all_of, ends, axis=1),
                                            strict=True)}
    return {KEY: found}


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values rounded to `DIGITS` digits, none smaller than `LEAST`.

    As quotients of an exact power of ten, so that they print with no more digits.
    """
    size = np.abs(values)
    digits = DIGITS - 1 - np.floor(np.log10(np.maximum(size, LEAST)))
    power = 10.0 ** np.maximum(digits, 0.0)
    return np.where(size < LEAST, 0.0, np.round(values * power) / power)


def factors_of(result: CalibrationResult) -> np.ndarray:
    """Return the factors L of a result, (r, 2, nx, ny), for unit noise; r = 0 without terms.

    Raises
    ------
    InputError
        If they do not match the result's lattice.
    """
    shape = (2, *result.artifact.shape)
    if KEY not in result.extra:
        return np.zeros((0, *shape))
    try:
        kept = result.extra[KEY]
        factors = np.array(kept["factors"], dtype=float).reshape(-1, *shape)
        good = np.isfinite(factors).all() and len(factors) == len(kept["terms"])
    except (TypeError, ValueError, KeyError):
        good = False
    if not good:
        raise InputError(KEY, "no factors of this lattice",
                         "write the result again with `selfcal solve`")
    return factors


def angular_terms(cover: MapsCovariance, columns: TermColumns, sigma_m: float,
                  known: np.ndarray) -> dict[str, Any]:
    """Return the contribution of each term of the lines to the angular map, for `extra`: rad, (K,).

    Parameters
    ----------
    cover, columns : MapsCovariance, TermColumns
        As in `saved_terms`.
    sigma_m : float
        Noise of one grid reading, m.
    known : bool array (K,)
        Lines of the map; their mean is the datum.
    """
    out = {}
    for name in dict.fromkeys(columns.columns[at].term for at in columns.lines.at):
        rows = columns.rows([name])
        moved = cover.terms.turned[:, rows]
        moved = moved - moved[known].mean(axis=0)
        power = np.einsum("kp,pq,kq->k", moved, cover.terms.covariance[np.ix_(rows, rows)], moved)
        out[str(name)] = rounded(np.sqrt(np.maximum(power, 0.0)) * sigma_m)
    return {ANGULAR_KEY: out} if out else {}


def variance_of_terms(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the variance of the map from each term with a size, (2, nx, ny), m^2."""
    factors = factors_of(result)
    names = np.array(result.extra[KEY]["terms"] if len(factors) else [], dtype=str)
    return {str(name): (factors[names == name] ** 2).sum(axis=0) * result.noise.sigma_xy**2
            for name in dict.fromkeys(names.tolist()) if name != FREE}
