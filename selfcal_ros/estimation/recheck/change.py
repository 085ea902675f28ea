# SPDX-License-Identifier: Apache-2.0
"""The change of a stage since the calibration of a plate (covariance of both maps).

The new map rests on the plate that the earlier calibration found together with its own map: what
it got wrong in one is in the other as well (method eq. 13.3).

Whether it has changed (method eq. 13.4) is told by three statistics of the same change: one for a
change at all nodes, one for a change at few, one for a smooth change. Draws of the change's noise
give the probability of the most telling of the three; every other one tells how large a change is
found.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtr

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import (
    DRAWS,
    USUAL_LEVEL,
    ReducedNoise,
    joint_dof,
    of_square,
    significance,
)
from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.estimation.recheck.plate import KnownPlate, rows_at
from selfcal_ros.estimation.recheck.views import NOISE, TERMS, NewMap
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import MANY_DOF, datum_modes, rms
from selfcal_ros.model.recheck import (
    Detectable,
    LargestChange,
    LargestTurn,
    PlateCalibration,
    Recheck,
    ScaleChange,
    Significance,
)
from selfcal_ros.model.result import CalibrationResult

ORDER = 2
"""Degree of the polynomials of the third statistic."""

POWER = 0.9
"""Part of the changes of the size stated as found that are found."""


@dataclass(frozen=True, eq=False)
class ChangeTests(ReducedNoise):
    """Statistics of changes of a map, Gx first, then Gy, (2n,), without what the datum removes.

    Attributes
    ----------
    places : complex array (n,)
        Nodes, in any unit.
    """

    places: np.ndarray

    @cached_property
    def _smooth(self) -> np.ndarray:
        """Orthonormal polynomials of both coordinates that are free from `removed`, (2n, k)."""
        z = self.places / np.abs(self.places).max()
        columns = np.stack(
            [
                z.real**i * z.imag**j
                for i in range(ORDER + 1)
                for j in range(ORDER + 1 - i)
            ],
            axis=1,
        )
        basis, size, _ = np.linalg.svd(
            self.without(np.kron(np.eye(2), columns)), full_matrices=False
        )
        return basis[:, size > np.sqrt(GAP) * size[0]]

    @cached_property
    def _whiten_smooth(self) -> np.ndarray:
        """Rows from a change to its polynomials, of variance 1 and independent, (k, 2n)."""
        factor = np.linalg.cholesky(self._smooth.T @ self.remaining @ self._smooth)
        return np.linalg.solve(factor, self._smooth.T)

    def normalised(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return changes (2n, draws) as the three statistics see them, with unit variance.

        Along their axes (rank, draws), at the nodes (2, n, draws), as polynomials (k, draws).
        """
        ratio = values / self.u[:, None]
        at_nodes = ratio.reshape(2, len(self.places), -1)
        return self.white(ratio), at_nodes, self._whiten_smooth @ values

    @cached_property
    def _noise(self) -> np.ndarray:
        """Changes that are noise only, (2n, DRAWS), m."""
        return self.u[:, None] * self.drawn

    @cached_property
    def _ranked(self) -> tuple[np.ndarray, np.ndarray]:
        """Statistics of noise, each in order, (3, DRAWS), and the least rank from above, sorted."""
        drawn = statistics(self.normalised(self._noise))
        ranks = DRAWS - np.argsort(np.argsort(drawn, axis=1), axis=1)
        return np.sort(drawn, axis=1), np.sort(ranks.min(axis=0))

    def p(self, values: np.ndarray) -> float:
        """Return the probability of as significant a change, (2n,), if there is none.

        A change beyond all draws has the bound, which is close there, if that is smaller.
        """
        of_change = statistics(self.normalised(values[:, None]))[:, 0]
        drawn, least = self._ranked
        rank = min(
            DRAWS - int(np.searchsorted(row, statistic)) + 1
            for row, statistic in zip(drawn, of_change, strict=True)
        )
        p = (1 + int(np.searchsorted(least, rank, side="right"))) / (1 + DRAWS)
        return p if rank > 1 else min(p, self._bound(values, of_change))

    def _bound(self, values: np.ndarray, of_change: np.ndarray) -> float:
        """Return a bound of the probability (Bonferroni)."""
        probabilities = [
            float(
                2
                * len(self.u)
                * stdtr(min(self.dof, MANY_DOF), -np.abs(values / self.u).max())
            ),
            of_square(of_change[0], self.rank, self.dof),
            of_square(of_change[2], self._smooth.shape[1], self.dof),
        ]
        return min(len(probabilities) * min(probabilities), 1.0)

    def detectable(self, level: float) -> Detectable:
        """Return the changes of which POWER are found if the tests have a level.

        At one node, any node and direction; and a smooth one, any polynomial.
        """
        drawn, least = self._ranked
        rank = int(least[max(int(level * DRAWS) - 1, 0)])
        limits = drawn[:, -rank][:, None]
        rng = np.random.default_rng(1)
        noise = self._noise[:, ::2]
        n = len(self.places)
        number = np.arange(noise.shape[1])
        nodes = rng.integers(n, size=len(number))
        turn = 2 * np.pi * rng.random(len(number))
        at_one_node = np.zeros(noise.shape)
        at_one_node[nodes, number], at_one_node[nodes + n, number] = (
            np.cos(turn),
            np.sin(turn),
        )
        smooth = self._smooth @ rng.standard_normal(
            (self._smooth.shape[1], len(number))
        )
        smooth /= np.sqrt((smooth**2).mean(axis=0))
        return Detectable(
            *(
                self._size(self.without(shape), noise, limits)
                for shape in (at_one_node, smooth)
            )
        )

    def _size(self, shape: np.ndarray, noise: np.ndarray, limits: np.ndarray) -> float:
        """Return the size of a change of given shape of which POWER are found, by bisection."""
        low = 0.0
        high = 20 * rms(self.u)
        unchanged, unit = self.normalised(noise), self.normalised(shape)
        for _ in range(10):
            size = (low + high) / 2
            changed = tuple(
                of_noise + size * of_shape
                for of_noise, of_shape in zip(unchanged, unit, strict=True)
            )
            is_found = (statistics(changed) >= limits).any(axis=0)
            low, high = (low, size) if is_found.mean() >= POWER else (size, high)
        return high


def statistics(changes: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return the three statistics of changes as `ChangeTests.normalised` returns them, (3, draws).

    Sums of squares; at the nodes of sixth powers, between a sum that all nodes share alike and the
    largest alone.
    """
    all_axes, at_nodes, smooth = ((values**2).sum(axis=0) for values in changes)
    return np.stack([all_axes, (at_nodes**3).sum(axis=0), smooth])


NO_SCALE = ScaleChange(False, math.nan, math.nan, math.nan)
"""Change of the scale of a map that has none."""


@dataclass(frozen=True, eq=False)
class Change:
    """Change of a map: new minus old, without motion, and without scale where none is known.

    Attributes
    ----------
    values, u : float array
        The change and its standard uncertainty, (2, nx, ny) in m, or (K,) in rad; NaN if unknown.
    test : Significance or None
        Its significance.
    p : float
        Probability of as large a change if there is none.
    scale : ScaleChange
        Of the XY map.
    tests : ChangeTests or None
        Tests of the XY map.
    """

    values: np.ndarray
    u: np.ndarray
    test: Significance | None
    p: float = 1.0
    scale: ScaleChange = NO_SCALE
    tests: ChangeTests | None = None

    @property
    def worst(self) -> tuple[int, ...]:
        """Index of the change that is largest against its uncertainty."""
        ratio = np.abs(self.values) / np.where(self.u > 0, self.u, np.inf)
        return tuple(map(int, np.unravel_index(np.nanargmax(ratio), ratio.shape)))


def map_change(new: NewMap, artifact: Artifact, plate: KnownPlate) -> Change:
    """Return the change of the XY map, of nodes `artifact`, since the calibration of the plate.

    Raises
    ------
    InputError
        If less than three nodes are known in both maps.
    """
    common, values, tests = _compared(new, artifact, plate)
    covariance, dof = tests.covariance, tests.dof
    modes = datum_modes(artifact, scale=True).reshape(4, -1).T[common]
    in_datum = tests.without(values)
    test = significance(in_datum, tests)
    row = scale_row(modes)
    scale = float(row @ values)
    u_scale = float(np.sqrt(row @ covariance @ row))
    p_scale = 2 * float(stdtr(min(dof, MANY_DOF), -abs(scale) / u_scale))

    out = np.full((2, len(common)), np.nan)
    out[:, common] = in_datum, np.sqrt(np.maximum(tests.variance, 0.0))
    changes, u = out.reshape(2, 2, *artifact.shape)
    return Change(
        values=changes,
        u=u,
        test=test,
        p=1.0 if test is None else tests.p(in_datum),
        scale=ScaleChange(p_scale < USUAL_LEVEL, scale, u_scale, p_scale),
        tests=None if test is None else tests,
    )


def _compared(
    new: NewMap, artifact: Artifact, plate: KnownPlate
) -> tuple[np.ndarray, np.ndarray, ChangeTests]:
    """Return where both XY maps are known, new minus old there, and the tests of that.

    Raises
    ------
    InputError
        As `map_change`.
    """
    old, sites = plate.result.error_map, plate.together.sites
    z = (artifact.x_m + 1j * artifact.y_m).ravel()
    rows, known_before = rows_at(z, plate)
    common = new.known & np.tile(known_before, 2)
    if common.sum() < 6:
        raise InputError(
            plate.where,
            f"only {common.sum() // 2} nodes are known in both maps",
            "measure where its map is known",
        )
    values, covariance, dof = _difference(
        new,
        common,
        np.kron(np.eye(2), rows),
        np.concatenate([old.gx[sites], old.gy[sites]]),
        plate=plate,
        dof=plate.result.noise.dof_xy,
    )
    modes = datum_modes(artifact, scale=True).reshape(4, -1).T[common]
    basis = modes if plate.reference is None else modes[:, :3]
    basis = basis / np.linalg.norm(basis, axis=0)
    places = z[common[: len(z)]]
    return common, values, ChangeTests(covariance, basis, dof, places)


@dataclass(frozen=True, eq=False)
class OtherCause:
    """Effects of any size that explain a change of the XY map of a stage that is as it was.

    Attributes
    ----------
    values, u : float array (e,)
        Their sizes beyond what was assumed, and standard uncertainties.
    p_none : float
        Probability of as large ones if there are none.
    p_left : float
        Probability of as large a change as they leave, if they are the only cause.
    """

    values: np.ndarray
    u: np.ndarray
    p_none: float
    p_left: float


def change_by_effects(
    new: NewMap, artifact: Artifact, plate: KnownPlate, rows: Sequence[int]
) -> OtherCause:
    """Return the effects, of those in `rows`, that explain a change of the XY map best."""
    common, values, tests = _compared(new, artifact, plate)
    of_effects = tests.without(new.of_effects[common[new.known]][:, rows])
    change = tests.without(values)
    white_effects, white = (
        tests.white((changes.T / tests.u).T) for changes in (of_effects, change)
    )
    information = white_effects.T @ white_effects
    covariance = np.linalg.pinv(information, hermitian=True)
    effects = covariance @ (white_effects.T @ white)
    return OtherCause(
        effects,
        np.sqrt(covariance.diagonal()),
        of_square(float(effects @ information @ effects), len(rows), tests.dof),
        tests.p(change - of_effects @ effects),
    )


def _difference(
    new: NewMap,
    common: np.ndarray,
    rows: np.ndarray,
    old: np.ndarray,
    *,
    plate: KnownPlate,
    dof: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return new minus old map where both are known, its covariance and degrees of freedom.

    By the noise of the new readings, and by the calibration: what it got wrong is in the old map
    and, by the plate, in the new one; so is the expansion of the plate since.

    Parameters
    ----------
    new : NewMap
        The new map.
    common : bool array (n,)
        Where both are known.
    rows : float array (n, j)
        The old map there for a unit of each of its known values.
    old : float array (j,)
        These.
    plate : KnownPlate
        The plate.
    dof : float
        Degrees of freedom of the calibration.
    """
    in_both = common[new.known]
    rows = rows[common]
    by_calibration = -np.hstack([rows, new.from_plate[in_both]])
    longer = new.from_length[in_both]
    of_new = new.covariances(0.0)
    of_noise = (of_new[NOISE] + of_new[TERMS])[np.ix_(in_both, in_both)]
    of_old = by_calibration @ new.effects.before @ by_calibration.T
    of_old += plate.variance_of_expansion * np.outer(longer, longer)
    return (
        new.values[in_both] - rows @ old,
        of_noise + of_old,
        joint_dof((np.trace(of_noise), new.dof), (np.trace(of_old), dof)),
    )


def line_change(new: NewMap, plate: KnownPlate) -> Change:
    """Return the change of the angular map since the calibration of the plate."""
    old = plate.result.error_map.g_theta
    count = len(new.known)
    common = plate.together.lines()[0][0] & new.known
    out = np.full((2, count), np.nan)
    if common.sum() < 2:
        return Change(out[0], out[1], None)
    values, covariance, dof = _difference(
        new,
        common,
        np.eye(count),
        np.nan_to_num(old),
        plate=plate,
        dof=plate.result.noise.dof_theta,
    )
    spread = ReducedNoise(covariance, np.ones((len(values), 1)), dof)
    values = values - values.mean()
    out[:, common] = values, np.sqrt(np.maximum(spread.variance, 0.0))
    test = significance(values, spread)
    return Change(
        out[0],
        out[1],
        test,
        1.0 if test is None else min(2 * test.p, 2 * test.p_z, 1.0),
    )


def scale_row(modes: np.ndarray) -> np.ndarray:
    """Return the least-squares scale as a row, (n,), given translations, rotation and scale."""
    size = np.abs(modes).max(axis=0)
    return np.linalg.pinv(modes / size)[3] / size[3]


def recheck_found(
    change: Change, lines: Change, artifact: Artifact, plate: KnownPlate, *, passes: int
) -> Recheck:
    """Return what a result says of the changes of both maps.

    `passes` are those of the view with the fewest.
    """
    axis, *node = change.worst
    at = tuple(node)
    largest = LargestChange(
        float(artifact.x_m[at]),
        float(artifact.y_m[at]),
        "xy"[axis],
        float(change.values[change.worst]),
        float(change.u[change.worst]),
    )
    tested = [of_map.p for of_map in (change, lines) if of_map.test is not None]
    p = min(len(tested) * min(tested), 1.0) if tested else float("nan")
    (dx, dy), (u_dx, u_dy) = change.values, change.u
    outcome = Recheck(
        of=plate.where,
        calibration=_calibration(plate.result),
        changed=p < USUAL_LEVEL,
        p=p,
        largest=largest,
        rms=rms(change.values),
        u_rms=rms(change.u),
        p_xy=change.p,
        significance_xy=change.test,
        scale=change.scale,
        dx=dx,
        dy=dy,
        u_dx=u_dx,
        u_dy=u_dy,
        passes=passes,
    )
    if change.tests is not None:
        outcome = replace(
            outcome, detectable=change.tests.detectable(USUAL_LEVEL / len(tested))
        )
    if lines.test is None:
        return outcome
    (line,) = lines.worst
    return replace(
        outcome,
        p_theta=lines.p,
        significance_theta=lines.test,
        d_theta=lines.values,
        u_d_theta=lines.u,
        largest_theta=LargestTurn(
            line, float(lines.values[line]), float(lines.u[line])
        ),
    )


def _calibration(result: CalibrationResult) -> PlateCalibration:
    provenance = result.provenance
    return PlateCalibration(
        plan_id=result.plan_id,
        run_id=result.run_id,
        created=provenance.created,
        readings=dict(result.input),
        first_exposure=provenance.first_exposure or None,
        last_exposure=provenance.last_exposure or None,
    )
