# SPDX-License-Identifier: Apache-2.0
"""The change of a stage since the calibration of a plate (covariance of both maps).

The new map rests on the plate that the earlier calibration found together with its own map: what
it got wrong in one is in the other as well (method eq. 13.3).
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import stdtr

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import (
    DIFFERENCE_LEVEL,
    PITCH_TOLERANCE,
    Significance,
    joint_dof,
    significance,
    without,
)
from selfcal_ros.estimation.recheck.detection import ChangeTests
from selfcal_ros.estimation.recheck.plate import KnownPlate, rows_at
from selfcal_ros.estimation.recheck.views import Gain
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import MANY_DOF, datum_modes, rms


@dataclass(frozen=True, eq=False)
class NewMap:
    """A map from a known plate, stage frame, its scale relative to the plate.

    Attributes
    ----------
    artifact : Artifact
        Its nodes.
    known : bool array (nx, ny)
        Which of them are known.
    xy : float array (2, nx, ny)
        The map, no translation and rotation, m.
    gain : Gain
        Of the map (2 nx ny), from the readings; its noise without that of the plate, m^2.
    white : float array (2 r,)
        Variance of the noise of each reading by itself, m^2.
    images : float array (2 r, 2 stops)
        The readings for the noise of each image, m.
    plate : float array (r, 2 m + 4)
        The readings for a unit of Ax, Ay at each known mark, and of the microscope.
    marks : bool array (mx, my)
        Known marks.
    dof : float
        Degrees of freedom of the noise of the readings.
    """

    artifact: Artifact
    known: np.ndarray
    xy: np.ndarray
    gain: Gain
    white: np.ndarray
    images: np.ndarray
    plate: np.ndarray
    marks: np.ndarray
    dof: float

    def variances(self, plate: KnownPlate) -> dict[str, np.ndarray]:
        """Return the variances of the map by their sources, (2 n,), m^2.

        Without scale unless a reference length sets it.
        """
        nowhere = np.zeros(plate.kept.sites.shape, dtype=bool)
        rows = self.gain.rows
        if plate.reference is None:
            rows = self.without_scale(rows)
        moved = rows @ self.plate
        of_plate = np.einsum("ij,ij->i", moved @ plate.kept.cover(nowhere, self.marks), moved)
        of_noise = np.einsum("ij,j,ij->i", rows, self.white, rows)
        of_noise += ((rows @ self.images)**2).sum(axis=1)
        whole = np.einsum("ij,ij->i", rows @ self.gain.noise, rows)
        of_length = plate.variance_of_length * (moved @ plate.length_at(self.marks))**2
        return {"reading noise": of_noise, "known plate": np.maximum(of_plate, 0.0),
                "plate temperature": of_length, "terms": np.maximum(whole - of_noise, 0.0)}

    def covariance(self, plate: KnownPlate) -> np.ndarray:
        """Return the covariance of the map at the known nodes, Gx, then Gy, m^2, as `variances`."""
        nowhere, rows = np.zeros(plate.kept.sites.shape, dtype=bool), self.gain.rows
        if plate.reference is None:
            rows = self.without_scale(rows)
        rows = rows[np.tile(self.known.ravel(), 2)]
        moved = rows @ self.plate
        by_length = moved @ plate.length_at(self.marks)
        return rows @ self.gain.noise @ rows.T + moved @ plate.kept.cover(
            nowhere, self.marks) @ moved.T + plate.variance_of_length * np.outer(
            by_length, by_length)

    def without_scale(self, values: np.ndarray) -> np.ndarray:
        """Return maps (2 n, ...) without motion and magnification over the known nodes."""
        here, out = np.tile(self.known.ravel(), 2), np.zeros(values.shape)
        q = np.linalg.qr(datum_modes(self.artifact, scale=True).reshape(4, -1).T[here])[0]
        out[here] = values[here] - q @ (q.T @ values[here])
        return out


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


def map_change(new: NewMap, plate: KnownPlate) -> Change:
    """Return the change of the XY map since the calibration of the plate.

    Raises
    ------
    InputError
        If less than three nodes are known in both maps.
    """
    old = plate.result.error_map
    rows, sites, there = _on_nodes(new.artifact, plate)
    common = new.known & there
    if common.sum() < 3:
        raise InputError(plate.where, f"only {int(common.sum())} nodes are known in both maps",
                         "measure where its map is known")
    here, w = np.tile(common.ravel(), 2), rows[common.ravel()]
    both = np.kron(np.eye(2), w)
    values = new.xy.reshape(-1)[here] - both @ np.concatenate([old.gx[sites], old.gy[sites]])
    gain = new.gain.rows[here]
    moved = -np.hstack([both, gain @ new.plate])
    of_old = moved @ plate.kept.cover(sites, new.marks) @ moved.T
    by_expansion = gain @ new.plate @ plate.length_at(new.marks)
    of_new = gain @ new.gain.noise @ gain.T
    of_old += plate.variance_of_expansion * np.outer(by_expansion, by_expansion)
    dof = joint_dof((np.trace(of_new), new.dof), (np.trace(of_old), plate.result.noise.dof_xy))
    modes = datum_modes(new.artifact, scale=True).reshape(4, -1).T[here]
    basis = modes if plate.reference is None else modes[:, :3]
    basis = basis / np.linalg.norm(basis, axis=0)
    cover = of_new + of_old
    z = (new.artifact.x_m + 1j * new.artifact.y_m)[common]
    tests = ChangeTests(z, cover, basis, dof)
    rest = tests.without(values)
    test = significance(rest, [(cover, True)], basis, dof)
    part = scale_row(modes)
    scale, u_scale = float(part @ values), float(np.sqrt(part @ cover @ part))
    out = np.full((2, 2 * new.known.size), np.nan)
    out[:, here] = rest, _u_without(cover, basis)
    shape = (2, *new.known.shape)
    return Change(out[0].reshape(shape), out[1].reshape(shape), test,
                  1.0 if test is None else tests.p(rest), scale, u_scale,
                  2 * float(stdtr(min(dof, MANY_DOF), -abs(scale) / u_scale)),
                  None if test is None else tests)


def scale_row(modes: np.ndarray) -> np.ndarray:
    """Return the least-squares scale as a row, (n,), given translations, rotation and scale."""
    size = np.abs(modes).max(axis=0)
    return np.linalg.pinv(modes / size)[3] / size[3]


def _u_without(cover: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return standard uncertainties after the least-squares parts in a basis are taken off."""
    return np.sqrt(np.maximum(np.diag(without(cover, np.linalg.qr(basis)[0])), 0.0))


def _on_nodes(artifact: Artifact, plate: KnownPlate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows from known nodes of the old map to those of another, and where it is known.

    Rows (n, s), the nodes used, bool (ox, oy), and nodes of the other map, bool (nx, ny).
    """
    kept, old = plate.kept.sites, plate.result.artifact
    if artifact.shape == old.shape and abs(
            artifact.grid_pitch_m / old.grid_pitch_m - 1) < PITCH_TOLERANCE:
        return np.eye(kept.size)[:, kept.ravel()], kept, kept
    rows, kept, inside = rows_at((artifact.x_m + 1j * artifact.y_m).ravel(), plate)
    return rows, kept, inside.reshape(artifact.shape)


@dataclass(frozen=True, eq=False)
class NewLines:
    """An angular map from a known plate, stage frame.

    Attributes
    ----------
    values : float array (K,)
        The map, rad, its mean 0; NaN where unknown.
    gain : Gain
        Of the map from the readings; its noise without that of the plate, rad^2.
    plate : float array (r, K)
        The readings for a unit of Atheta at each line.
    dof : float
        Degrees of freedom of the noise of the readings.
    """

    values: np.ndarray
    gain: Gain
    plate: np.ndarray
    dof: float

    def covariance(self, plate: KnownPlate) -> np.ndarray:
        """Return the covariance of the map, (K, K), rad^2."""
        count, moved = len(self.values), self.gain.rows @ self.plate
        return self.gain.covariance + moved @ plate.kept.lines()[1][count:, count:] @ moved.T


def line_change(new: NewLines, plate: KnownPlate) -> Change:
    """Return the change of the angular map since the calibration of the plate."""
    (known, _), cover = plate.kept.lines()
    old, count = plate.result.error_map.g_theta, len(new.values)
    here = known & np.isfinite(new.values)
    out = np.full((2, count), np.nan)
    if here.sum() < 2:
        return Change(out[0], out[1], None)
    values, rows = (new.values - old)[here], new.gain.rows[here]
    moved = -np.hstack([np.eye(count)[here], rows @ new.plate])
    of_new, of_old = rows @ new.gain.noise @ rows.T, moved @ cover @ moved.T
    dof = joint_dof((np.trace(of_new), new.dof),
                    (np.trace(of_old), plate.result.noise.dof_theta))
    basis = np.ones((len(values), 1))
    values = values - values.mean()
    out[:, here] = values, _u_without(of_new + of_old, basis)
    test = significance(values, [(of_new + of_old, True)], basis, dof)
    return Change(out[0], out[1], test, 1.0 if test is None else min(2 * test.p, 2 * test.p_z, 1.0))


def record(change: Change, lines: Change, artifact: Artifact, plate: KnownPlate) -> dict[str, Any]:
    """Return what a result says of a recheck: `recheck` in RESULT.json, SI units."""
    before = plate.result
    dates = {name: text for name in ("first_exposure", "last_exposure")
             if (text := before.provenance.extra.get(name))}
    i, j, k = change.worst
    parts = [part for part in (change, lines) if part.test is not None]
    p = min(len(parts) * min(part.p for part in parts), 1.0) if parts else float("nan")
    at = (j, k)
    largest = {"x": float(artifact.x_m[at]), "y": float(artifact.y_m[at]), "axis": "xy"[i],
               "change": float(change.values[i, j, k]), "u": float(change.u[i, j, k])}
    found: dict[str, Any] = {
        "of": plate.where, "calibration": {
            "plan_id": before.plan_id, "run_id": before.run_id, "created":
            before.provenance.created, "readings": dict(before.input), **dates},
        "changed": bool(p < DIFFERENCE_LEVEL), "p": p, "largest": largest,
        "rms": rms(change.values), "u_rms": rms(change.u), "p_xy": change.p,
        "significance_xy": None if change.test is None else asdict(change.test),
        "scale": {"changed": bool(change.p_scale < DIFFERENCE_LEVEL), "change": change.scale,
                  "u": change.u_scale, "p": change.p_scale},
        "dx": change.values[0], "dy": change.values[1], "u_dx": change.u[0], "u_dy": change.u[1]}
    if change.tests is not None:
        found["detectable"] = change.tests.found(DIFFERENCE_LEVEL / len(parts))
    if lines.test is not None:
        line = lines.worst[0]
        found |= {"p_theta": lines.p, "significance_theta": asdict(lines.test),
                  "d_theta": lines.values, "u_d_theta": lines.u,
                  "largest_theta": {"line": line, "change": float(lines.values[line]),
                                    "u": float(lines.u[line])}}
    return found
