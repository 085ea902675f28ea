# SPDX-License-Identifier: Apache-2.0
"""The change of a stage since the calibration of a plate (covariance of both maps).

The new map rests on the plate that the earlier calibration found together with its own map: what
it got wrong in one is in the other as well (method eq. 13.3).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import (
    DIFFERENCE_LEVEL,
    PITCH_TOLERANCE,
    Spread,
    joint_dof,
    significance,
)
from selfcal_ros.estimation.recheck.detection import ChangeTests
from selfcal_ros.estimation.recheck.plate import KnownPlate, rows_at
from selfcal_ros.estimation.recheck.views import NewMap
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import MANY_DOF, datum_modes, rms
from selfcal_ros.model.recheck import (
    LargestChange,
    LargestTurn,
    PlateCalibration,
    Recheck,
    ScaleChange,
    Significance,
)
from selfcal_ros.model.result import CalibrationResult


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
    scale, u_scale, p_scale : float
        Change of the scale against the plate, m/m.
    tests : ChangeTests or None
        Tests of the XY map.
    """

    values: np.ndarray
    u: np.ndarray
    test: Significance | None
    p: float = 1.0
    scale: float = float("nan")
    u_scale: float = float("nan")
    p_scale: float = float("nan")
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
    old, sites = plate.result.error_map, plate.together.sites
    rows, known_before = _on_nodes(artifact, plate)
    common = new.known & np.tile(known_before, 2)
    if common.sum() < 6:
        raise InputError(plate.where, f"only {common.sum() // 2} nodes are known in both maps",
                         "measure where its map is known")
    values, of_new, of_old = _difference(new, common, np.kron(np.eye(2), rows), np.concatenate(
        [old.gx[sites], old.gy[sites]]))
    by_expansion = new.from_length[common[new.known]]
    of_old = of_old + plate.variance_of_expansion * np.outer(by_expansion, by_expansion)
    dof = joint_dof((np.trace(of_new), new.dof), (np.trace(of_old), plate.result.noise.dof_xy))
    covariance = of_new + of_old

    modes = datum_modes(artifact, scale=True).reshape(4, -1).T[common]
    basis = modes if plate.reference is None else modes[:, :3]
    basis = basis / np.linalg.norm(basis, axis=0)
    z = (artifact.x_m + 1j * artifact.y_m).ravel()[common[:artifact.m.size]]
    tests = ChangeTests(covariance, basis, dof, z)
    in_datum = tests.without(values)
    test = significance(in_datum, tests)
    row = scale_row(modes)
    scale, u_scale = float(row @ values), float(np.sqrt(row @ covariance @ row))

    out = np.full((2, len(common)), np.nan)
    out[:, common] = in_datum, np.sqrt(np.maximum(tests.variance, 0.0))
    changes, u = out.reshape(2, 2, *artifact.shape)
    return Change(changes, u, test, 1.0 if test is None else tests.p(in_datum), scale, u_scale,
                  2 * float(stdtr(min(dof, MANY_DOF), -abs(scale) / u_scale)),
                  None if test is None else tests)


def _difference(new: NewMap, common: np.ndarray, rows: np.ndarray,
                old: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return new minus old map where both are known, and the covariances of its two sources.

    Those of the noise of the new readings, and of the calibration: what it got wrong is in the old
    map and, by the plate, in the new one.

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
    """
    here, rows = common[new.known], rows[common]
    by_calibration = -np.hstack([rows, new.from_plate[here]])
    return (new.values[here] - rows @ old, new.of_noise[np.ix_(here, here)],
            by_calibration @ new.before @ by_calibration.T)


def line_change(new: NewMap, plate: KnownPlate) -> Change:
    """Return the change of the angular map since the calibration of the plate."""
    old, count = plate.result.error_map.g_theta, len(new.known)
    common = plate.together.lines()[0][0] & new.known
    out = np.full((2, count), np.nan)
    if common.sum() < 2:
        return Change(out[0], out[1], None)
    values, of_new, of_old = _difference(new, common, np.eye(count), np.nan_to_num(old))
    dof = joint_dof((np.trace(of_new), new.dof),
                    (np.trace(of_old), plate.result.noise.dof_theta))
    spread = Spread(of_new + of_old, np.ones((len(values), 1)), dof)
    values = values - values.mean()
    out[:, common] = values, np.sqrt(np.maximum(spread.variance, 0.0))
    test = significance(values, spread)
    return Change(out[0], out[1], test, 1.0 if test is None else min(2 * test.p, 2 * test.p_z, 1.0))


def scale_row(modes: np.ndarray) -> np.ndarray:
    """Return the least-squares scale as a row, (n,), given translations, rotation and scale."""
    size = np.abs(modes).max(axis=0)
    return np.linalg.pinv(modes / size)[3] / size[3]


def _on_nodes(artifact: Artifact, plate: KnownPlate) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows from known nodes of the old map to those of another, and where it is known.

    Rows (n, s), and nodes of the other map, bool (n,).
    """
    known, old = plate.together.sites.ravel(), plate.result.artifact
    if artifact.shape == old.shape and abs(
            artifact.grid_pitch_m / old.grid_pitch_m - 1) < PITCH_TOLERANCE:
        return np.eye(len(known))[:, known], known
    return rows_at((artifact.x_m + 1j * artifact.y_m).ravel(), plate)


def recheck_found(change: Change, lines: Change, artifact: Artifact, plate: KnownPlate, *,
                  passes: int) -> Recheck:
    """Return what a result says of the changes of both maps.

    `passes` are those of the view with the fewest.
    """
    axis, *node = change.worst
    at = tuple(node)
    largest = LargestChange(float(artifact.x_m[at]), float(artifact.y_m[at]), "xy"[axis],
                            float(change.values[change.worst]), float(change.u[change.worst]))
    tested = [part.p for part in (change, lines) if part.test is not None]
    p = min(len(tested) * min(tested), 1.0) if tested else float("nan")
    scale = ScaleChange(change.p_scale < DIFFERENCE_LEVEL, change.scale, change.u_scale,
                        change.p_scale)
    (dx, dy), (u_dx, u_dy) = change.values, change.u
    found = Recheck(
        plate.where, _calibration(plate.result), p < DIFFERENCE_LEVEL, p, largest,
        rms(change.values), rms(change.u), p_xy=change.p, significance_xy=change.test, scale=scale,
        dx=dx, dy=dy, u_dx=u_dx, u_dy=u_dy, passes=passes)
    if change.tests is not None:
        found = replace(found, detectable=change.tests.detectable(DIFFERENCE_LEVEL / len(tested)))
    if lines.test is None:
        return found
    line, = lines.worst
    return replace(
        found, p_theta=lines.p, significance_theta=lines.test, d_theta=lines.values,
        u_d_theta=lines.u, largest_theta=LargestTurn(line, float(lines.values[line]),
                                                     float(lines.u[line])))


def _calibration(result: CalibrationResult) -> PlateCalibration:
    first, last = (result.provenance.extra.get(name) or None
                   for name in ("first_exposure", "last_exposure"))
    return PlateCalibration(result.plan_id, result.run_id, result.provenance.created,
                            dict(result.input), first, last)
