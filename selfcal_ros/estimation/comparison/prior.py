# SPDX-License-Identifier: Apache-2.0
"""A Gaussian process as the prior of a stage's map (method section 15).

Each coordinate of the stage's error beyond first order is taken for a smooth random field. Its size
and correlation length follow from the map itself (restricted likelihood), and the map becomes the
mean of the field given the readings. A node that stands off it, as where the stage is scratched,
is left to its readings. First-order parts, and with them the datum, have no prior.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space
from scipy.special import chdtri, fdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.solved import KEY, factors_of
from selfcal_ros.estimation.lattice.connectivity import first_order
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.options import PRIORS
from selfcal_ros.estimation.verdict.uncertainty import budget_lines
from selfcal_ros.model.error_map import ErrorMap, datum_modes, rms
from selfcal_ros.model.result import PRIOR, CalibrationResult
from selfcal_ros.model.verdict import BudgetLine, Finding

SHORTEST = 2.0
"""Shortest correlation length, in pitches, with which a prior is used."""

LEVEL = 1e-3
"""Probability that a field for which the prior holds contradicts it, in each of the tests."""

STANDS_OFF, MOST = 0.5, 0.05
"""Nodes of a field for which the prior holds that are left out by chance, in each map on average,
and the largest part of the nodes that may be left out."""

SURE_DOF = 1e5
"""Degrees of freedom of noise that counts as known."""

LENGTHS = (0.7, 1.5, 3.0, 6.0, 12.0)
"""Correlation lengths from which the search starts, in pitches."""

JITTER = 1e-8
"""White part of the field, relative to its variance, that keeps its covariance regular."""

MAPS, FIRST_ORDER = ("gx", "gy", "u_gx", "u_gy"), ("nonorthogonality", "scale_difference")
"""What a result keeps of the map of the readings alone."""

REMEDY = "solve without a prior"

Covariance = Callable[[CalibrationResult, np.ndarray], tuple[np.ndarray, bool]]


@dataclass(frozen=True, eq=False)
class Field:
    """Values of a map at its nodes with their covariance, Gx first, then Gy.

    Attributes
    ----------
    places : complex array (n,)
        Nodes, in pitches.
    values : float array (2n,)
        Of the map, m.
    covariance : float array (2n, 2n)
        Of the values, m^2.
    modes : float array (2n, k)
        Datum modes, which neither values nor covariance contain.
    dof : float
        Degrees of freedom of the noise behind the covariance.
    held : bool array (n,)
        Nodes that belong to the smooth field; the others have no prior.
    """

    places: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    modes: np.ndarray
    dof: float
    held: np.ndarray

    @cached_property
    def unit(self) -> float:
        """Return the mean uncertainty, m: the unit in which a size is looked for."""
        return float(np.sqrt(np.diag(self.covariance).mean()))

    @cached_property
    def beyond(self) -> np.ndarray:
        """Orthonormal contrasts of a coordinate, free from first-order parts, (n, n held - 3)."""
        z = self.places[self.held]
        out = np.zeros((len(self.held), len(z) - 3))
        first = np.stack([np.ones(len(z)), z.real, z.imag], axis=1)
        out[self.held] = np.linalg.qr(first, mode="complete")[0][:, 3:]
        return out

    @cached_property
    def _contrasts(self) -> tuple[np.ndarray, np.ndarray]:
        """Contrasts of both coordinates and their covariance."""
        both = np.kron(np.eye(2), self.beyond)
        return both.T @ self.values, both.T @ self.covariance @ both

    def correlation(self, length: float) -> np.ndarray:
        """Return the correlation of the contrasts of a coordinate."""
        square = np.abs(self.places[:, None] - self.places) ** 2
        return self.beyond.T @ np.exp(-square / (2 * length**2)) @ self.beyond

    def misfit(self, size: float, length: float, noise: float = 1.0,
               white: float = 0.0) -> tuple[float, float]:
        """Return -2 log likelihood of the contrasts and their Mahalanobis square (eq. 15.2).

        With `noise` times the noise that the covariance says, which has `dof` degrees of freedom,
        and a part `white`, m, that differs from node to node.
        """
        values, dof = self._contrasts[0], min(self.dof, SURE_DOF)
        factor = self._factor(size, length, noise, white)
        square = float(values @ cho_solve(factor, values))
        of_noise = dof * (2 * np.log(noise) + noise**-2.0 - 1)
        return 2 * float(np.log(np.diag(factor[0])).sum()) + square + of_noise, square

    def _factor(self, size: float, length: float, noise: float,
                white: float) -> tuple[np.ndarray, bool]:
        """Return the factor of the covariance of the contrasts."""
        own = self._contrasts[1]
        field = size**2 * self.correlation(length) if size else np.zeros((len(own) // 2,) * 2)
        field[np.diag_indices(len(field))] += white**2
        return cho_factor(noise**2 * own + np.kron(np.eye(2), field), lower=True)

    def stands_off(self, size: float, length: float, noise: float) -> tuple[int, float]:
        """Return the node that deviates most from its prediction by the others, and its p value.

        By its Mahalanobis square about the field of the other nodes; p is of that one node.
        """
        values, both = self._contrasts[0], np.kron(np.eye(2), self.beyond)
        solved = cho_solve(self._factor(size, length, noise, 0.0), both.T)
        n, at = len(self.places), np.flatnonzero(self.held)
        pair = np.stack([at, at + n], axis=-1)
        inverse = np.stack([np.einsum("ik,ki->i", both[pair[:, i]], solved[:, pair[:, j]])
                            for i in (0, 1) for j in (0, 1)], axis=-1).reshape(-1, 2, 2)
        off = (values @ solved)[pair]
        squares = np.einsum("ni,ni->n", off, np.linalg.solve(inverse, off[..., None])[..., 0])
        worst = int(np.argmax(squares))
        return int(at[worst]), float(fdtrc(2, min(self.dof, SURE_DOF), squares[worst] / 2))

    def conditioned(self, size: float, length: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrix that applies the prior, (2n, 2n), and the covariance (eq. 15.3)."""
        own = size**2 * (self.correlation(length) + JITTER * np.eye(self.beyond.shape[1]))
        precision = np.kron(np.eye(2), self.beyond @ np.linalg.solve(own, self.beyond.T))
        free = null_space(self.modes.T)
        information = np.linalg.inv(free.T @ self.covariance @ free)
        after = free @ np.linalg.inv(information + free.T @ precision @ free)
        return after @ information @ free.T, after @ free.T


def estimated(field: Field) -> tuple[Field, float, float]:
    """Return the field without the nodes that deviate from it, its size, m, and length, pitches.

    Raises
    ------
    InputError
        If there is no error to learn them from, the length is below `SHORTEST`, or the map
        contradicts such a field.
    """
    at, found = _likeliest(field)
    while True:
        size, length, noise = np.exp(found).tolist()
        worst, p = field.stands_off(size * field.unit, length, noise)
        nodes = int(field.held.sum())
        if nodes * p > STANDS_OFF or nodes <= (1 - MOST) * len(field.held):
            break
        field = replace(field, held=field.held & (np.arange(len(field.held)) != worst))
        at, found = _likeliest(field, found)
    size *= field.unit
    best, dof = at(found), min(field.dof, SURE_DOF)
    n = 2 * field.beyond.shape[1]
    alone = np.sqrt((field.misfit(0.0, 1.0)[1] + dof) / (n + dof))  # the likeliest without a field
    if field.misfit(0.0, 1.0, float(alone))[0] - best < chdtri(2, LEVEL):
        raise InputError("prior", "the readings show no error of the stage beyond first order to "
                         "estimate it from", REMEDY)
    if length < SHORTEST:
        raise InputError("prior", f"the stage's error is correlated over {length:.3g} pitches, "
                         f"less than {SHORTEST:g}", REMEDY)
    p = float(fdtrc(n, dof, field.misfit(size, length)[1] / n))
    if p < LEVEL or best - at(_least(at, np.append(found, 0.0))) > chdtri(1, 2 * LEVEL):
        raise InputError("prior", "the readings contradict a smooth stage error with one "
                         "correlation length: part of its error is rougher", REMEDY)
    return field, size, length


Misfit = Callable[[np.ndarray], float]


def _likeliest(field: Field, start: np.ndarray | None = None) -> tuple[Misfit, np.ndarray]:
    """Return the misfit by the logarithms of size (in units), length, noise and white part, if any.

    And where it is least, without a white part.
    """
    widest = np.log(4 * float(np.abs(field.places[:, None] - field.places).max()))

    def at(logs: np.ndarray) -> float:
        """Return the misfit."""
        of = np.exp(np.clip(logs, (-9.0, -1.2, -1.0, -9.0)[:len(logs)],
                            (20.0, widest, 1.0, 20.0)[:len(logs)]))
        return field.misfit(of[0] * field.unit, of[1], of[2], float(of[3:].sum()) * field.unit)[0]

    sizes = np.log(max(rms(field.values) / field.unit, 1.0)) + np.array([-1.0, 0.0, 1.0])
    if start is None:
        start = min((np.array([size, np.log(length), 0.0]) for length in LENGTHS
                     for size in sizes), key=at)
    return at, _least(at, start)


def _least(of: Callable[[np.ndarray], float], start: np.ndarray) -> np.ndarray:
    """Return the position of the minimum near a start."""
    from scipy.optimize import minimize  # for this alone

    steps = np.vstack([np.zeros(len(start)), 0.5 * np.eye(len(start))])
    return minimize(of, start, method="Nelder-Mead", options={
        "initial_simplex": start + steps, "xatol": 1e-3, "fatol": 1e-3,
        "maxfev": 80 * len(start)}).x


@one_thread()
def with_prior(result: CalibrationResult, covariance: Covariance) -> CalibrationResult:
    """Return the result with the stage's map given the readings and the prior.

    All else remains that of the readings alone: plate, misalignments, residuals, verdict.

    Parameters
    ----------
    result : CalibrationResult
        A calibration.
    covariance : callable
        `selfcal_ros.estimation.comparison.covariance.xy_covariance`.

    Raises
    ------
    InputError
        If the covariance of the map is not known, or the map does not support the prior.
    """
    if not result.has_uncertainty:
        raise InputError("prior", "the uncertainty of the map is not known", REMEDY)
    field, size, length = estimated(field_of(result, covariance))
    emap = result.error_map
    pitch_m, known = emap.artifact.grid_pitch_m, emap.valid
    left_out = [[int(z.real), int(z.imag)] for z in field.places[~field.held]]
    gain, after = field.conditioned(size, length)
    facts: dict[str, Any] = {"kind": PRIORS[0], "size_m": size, "length_m": length * pitch_m,
                             "left_out": left_out,
                             **{name: getattr(emap, name) for name in (*MAPS, *FIRST_ORDER)}}
    g = _on_nodes(gain @ field.values, known)
    u = _on_nodes(np.sqrt(np.diag(after)), known)
    o, r = first_order(emap.artifact, g[0] + 1j * g[1])
    now = replace(emap, gx=g[0], gy=g[1], u_gx=u[0], u_gy=u[1], nonorthogonality=o,
                  scale_difference=r)
    result = replace(result, extra={**result.extra, PRIOR: facts})
    variances = np.diag(gain @ field.covariance @ gain.T)
    return replace(
        result, error_map=now, budget=_budget(result, now, gain, variances),
        findings=(*result.findings, Finding("prior", size, unit="m", details={
            "length_m": length * pitch_m, "left_out": left_out, "u_rms": rms(u),
            "u_rms_without": rms(np.stack([emap.u_gx, emap.u_gy]))})))


def field_of(result: CalibrationResult, covariance: Covariance) -> Field:
    """Return the map of a result as a field; InputError without its full covariance."""
    emap, known = result.error_map, result.error_map.valid
    cover, whole = covariance(result, known)
    if not whole:
        raise InputError("prior", "the covariance of the map is not known",
                         "solve up to 31 x 31 sites with the uncertainty map, or without a prior")
    modes = datum_modes(emap.artifact, scale=result.reference is None)[:, :, known]
    modes = np.linalg.qr(modes.reshape(len(modes), -1).T)[0]
    places = (emap.artifact.m + 1j * emap.artifact.n)[known]
    return Field(places, np.concatenate([emap.gx[known], emap.gy[known]]), cover, modes,
                 result.noise.dof_of("xy"), np.full(len(places), True))


def measured_alone(result: CalibrationResult) -> CalibrationResult:
    """Return the result with the map of the readings alone, without a prior."""
    if PRIOR not in result.extra:
        return result
    kept, emap = result.extra[PRIOR], result.error_map
    gx, gy, u_gx, u_gy = (np.array(kept[name], dtype=float) for name in MAPS)
    o, r = (float(kept[name]) for name in FIRST_ORDER)
    extra = {key: value for key, value in result.extra.items() if key != PRIOR}
    return replace(result, extra=extra, error_map=replace(
        emap, gx=gx, gy=gy, u_gx=u_gx, u_gy=u_gy, nonorthogonality=o, scale_difference=r))


def after_prior(result: CalibrationResult, known: np.ndarray,
                covariance: Covariance) -> np.ndarray:
    """Return the covariance of a map with a prior at some of its nodes, (2n, 2n), m^2."""
    facts, pitch_m = result.extra[PRIOR], result.error_map.artifact.grid_pitch_m
    field = field_of(measured_alone(result), covariance)
    left_out = [complex(*at) for at in facts.get("left_out", ())]
    field = replace(field, held=~np.isin(field.places, left_out))
    cover = field.conditioned(facts["size_m"], facts["length_m"] / pitch_m)[1]
    here = np.tile(known[result.error_map.valid], 2)
    return cover[np.ix_(here, here)]


def _on_nodes(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values at the known nodes, (2n,), as maps (2, nx, ny); NaN elsewhere."""
    out = np.full((2, *known.shape), np.nan)
    out[:, known] = values.reshape(2, -1)
    return out


def _budget(result: CalibrationResult, now: ErrorMap, gain: np.ndarray,
            told: np.ndarray) -> tuple[BudgetLine, ...]:
    """Return the budget: what the prior leaves of each line, and what it adds itself."""
    known, extra = now.valid, dict(result.extra)
    size, length_m = (float(extra[PRIOR][name]) for name in ("size_m", "length_m"))
    if KEY in extra:
        factors = factors_of(result)
        moved = [_on_nodes(gain @ one[:, known].ravel(), known) for one in factors]
        extra[KEY] = {**extra[KEY], "factors": [np.nan_to_num(one).tolist() for one in moved]}
    u = _on_nodes(np.sqrt(np.maximum(told, 0.0)), known)
    lines = [*budget_lines(replace(result, extra=extra, error_map=replace(
        now, u_gx=u[0], u_gy=u[1])))]
    rest = np.sqrt(np.maximum(np.stack([now.u_gx, now.u_gy]) ** 2 - u**2, 0.0))
    at = next((i for i, line in enumerate(lines) if line.component == "interpolation"), len(lines))
    own = BudgetLine("xy", "stage prior", "B", 0.0, size, "m", rms(rest),
                     float(np.nanmax(rest)), np.inf, "readings", {"prior_length_m": length_m})
    return (*lines[:at], own, *lines[at:])
