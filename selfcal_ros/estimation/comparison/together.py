# SPDX-License-Identifier: Apache-2.0
"""Joint covariance of the maps of stage and plate, from a saved result.

Exact for noise and terms of the model. What else enlarges u (unequal noise, noise in time, stages
read beside the sites) enlarges both maps in the ratio in which it enlarges that of the stage;
effects that are no terms enlarge the plate's by as much as the stage's, at every mark by itself.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import (
    MAX_LINES,
    half_width_m,
    images_behind,
    is_flipped,
    maps_behind,
    share_of,
    system_behind,
    unit_rows,
)
from selfcal_ros.estimation.datum.angular import LinesCovariance
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.images import ImageNoise
from selfcal_ros.estimation.joint.solved import BESIDE, KEY, MAX_FULL, OF_OFFSETS, factors_of
from selfcal_ros.estimation.lattice.connectivity import first_order
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult


@dataclass(frozen=True, eq=False)
class Together:
    """The covariances behind a result.

    Attributes
    ----------
    result : CalibrationResult
        The result.
    system : NormalEquations
        The readings behind it.
    """

    result: CalibrationResult
    system: NormalEquations

    @cached_property
    def sites(self) -> np.ndarray:
        """Sites with a known error and uncertainty, bool (nx, ny)."""
        emap = self.result.error_map
        return np.isfinite(emap.gx + emap.gy + emap.u_gx + emap.u_gy)

    @cached_property
    def marks(self) -> np.ndarray:
        """Marks with a known error and uncertainty, bool (nx, ny)."""
        plate = self.result.artifact_map
        return np.isfinite(plate.ax + plate.ay + plate.u_ax + plate.u_ay)

    @cached_property
    def _maps(self) -> MapsCovariance:
        return maps_behind(self.result, self.system)

    @cached_property
    def _images(self) -> ImageNoise | None:
        return images_behind(self.result, self.system)

    def _of_noise(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the covariance of functionals of both maps for noise of marks and images."""
        cover = self._maps.of(sites, marks)
        if self._images is None:
            return cover
        return cover + share_of(self.result) * self._images.added_covariance(
            self._maps.sensitivities(sites, marks))

    @cached_property
    def _effects(self) -> np.ndarray:
        """Effects that are no terms of the model, for unit noise, (e, 2, nx, ny)."""
        kept = self.result.extra.get(KEY, {}).get(BESIDE, {"with_map": 0})
        return factors_of(self.result)[int(kept["with_map"]):]

    def _factors(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the effect of terms and causes on G, A and the microscope, (r, q)."""
        plate, stage = self._kept("plate", (2, *marks.shape)), factors_of(self.result)
        effects, here = len(self._effects), 2 * int(sites.sum())
        n, r = len(stage) - effects, len(plate)
        maps = np.zeros((r + effects, here + 2 * int(marks.sum()) + 4))
        of_stage = stage[:, :, sites].reshape(len(stage), here)
        maps[:n, :here], maps[r:, :here] = of_stage[:n], of_stage[n:]
        maps[:r, here:-4] = plate[:, :, marks].reshape(r, maps.shape[1] - here - 4)
        maps[:r, -4:] = self._kept(OF_OFFSETS, (4,)) / half_width_m(self.result)
        return maps

    def _kept(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return the factors of a quantity beside the map, (r, ...)."""
        kept = self.result.extra.get(KEY, {}).get(BESIDE, {name: []})
        try:
            found = np.array(kept[name], dtype=float).reshape(-1, *shape)
        except (TypeError, ValueError, KeyError):
            found = np.full((1, *shape), np.nan)
        if not np.isfinite(found).all():
            raise InputError(KEY, f"no {name} of this plate",
                             "write the result again with `selfcal solve`")
        return found

    def cover(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the covariance of Gx, Gy at sites, Ax, Ay at marks, and the microscope.

        Float (2 s + 2 m + 4, ...), m^2; the microscope's (scale, turn, stretch, shear) in m/m.

        Parameters
        ----------
        sites, marks : bool array (nx, ny)
            Of the known ones.
        """
        s, m = 2 * int(sites.sum()), 2 * int(marks.sum())
        rows_g, rows_a = unit_rows(sites), unit_rows(marks)
        if is_flipped(self.result):  # G(X) = -H(-X)
            rows_g = -rows_g[:, ::-1, ::-1]
        exact = np.zeros((s + m + 4, s + m + 4))
        exact[:-4, :-4] = self._of_noise(
            np.concatenate([rows_g, np.zeros((m, *rows_g.shape[1:]))]),
            np.concatenate([np.zeros((s, *rows_a.shape[1:])), rows_a]))
        factors = self._factors(sites, marks)
        terms = len(factors) - len(self._effects)
        cover = exact + factors[:terms].T @ factors[:terms]
        if self._images is None:
            cover[:-4, :-4] *= self._ratio
        else:  # their noise moves the stage's map much and the plate's little
            root = np.sqrt(np.repeat([self._ratio, self._ratio_of_plate, 1.0], [s, m, 4]))
            cover *= np.outer(root, root)
        effects = factors[terms:]
        cover += effects.T @ effects
        if len(effects):
            cover[range(s, s + m), range(s, s + m)] += (self._effects**2).sum(axis=0).mean()
        return cover * self.result.noise.sigma_xy**2

    @cached_property
    def _ratio(self) -> float:
        """Variance of the stage's map over that of white noise and terms."""
        emap, known = self.result.error_map, self.sites
        rows = unit_rows(known)
        if is_flipped(self.result):
            rows = rows[:, ::-1, ::-1]
        white = np.trace(self._of_noise(rows, np.zeros((len(rows), *self.marks.shape))))
        factors = factors_of(self.result)[..., known]
        white += (factors**2).sum()
        effects = (self._effects[..., known] ** 2).sum()
        found = (emap.u_gx[known] ** 2 + emap.u_gy[known] ** 2).sum()
        sigma = max(self.result.noise.sigma_xy, np.finfo(float).tiny)
        return float(max((found / sigma**2 - effects) / (white - effects), 0.0))

    @cached_property
    def _ratio_of_plate(self) -> float:
        """The same for the plate's map, on which noise of images acts differently."""
        plate, known = self.result.artifact_map, self.marks
        rows = unit_rows(known)
        white = np.trace(self._of_noise(np.zeros((len(rows), *self.sites.shape)), rows))
        white += (self._kept("plate", (2, *known.shape))[..., known] ** 2).sum()
        found = (plate.u_ax[known] ** 2 + plate.u_ay[known] ** 2).sum()
        return float(found / white / max(self.result.noise.sigma_xy, np.finfo(float).tiny) ** 2)

    def lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lines known in both angular maps, bool (2, K), and their covariance, rad^2.

        (2 K, 2 K), the maps without their means over these lines; 0 elsewhere.
        """
        result, angular = self.result, self.system.angular
        count, emap, plate = angular.n_lines, result.error_map, result.artifact_map
        known = np.isfinite(np.stack([emap.g_theta + emap.u_g_theta,
                                      plate.a_theta + plate.u_a_theta]))
        if not angular.n_views or count > MAX_LINES or not known.any(axis=1).all():
            return np.zeros((2, count), dtype=bool), np.zeros((2 * count, 2 * count))
        centre = np.zeros((2 * count, 2 * count))
        for part, here in enumerate(known):
            at = part * count + np.flatnonzero(here)
            centre[np.ix_(at, at)] = np.eye(len(at)) - 1 / len(at)
        stage = centre[:, :count]
        if is_flipped(result):
            stage = -stage[:, -np.arange(count) % count]
        noise = result.noise
        cover = LinesCovariance(self._maps, (noise.sigma_xy, noise.sigma_theta)).of(
            stage.T, centre[:, count:].T)
        terms = self._kept("lines", (2 * count,)) @ centre.T * (
            noise.sigma_xy / half_width_m(result))
        cover = cover + terms.T @ terms
        white = np.diag(cover)[:count][known[0]].sum()
        found = (emap.u_g_theta[known[0]] ** 2).sum()
        return known, cover * max(float(found / white), 1.0)


def together(result: CalibrationResult) -> Together | None:
    """Return the joint covariance of stage and plate of a result; None if it is incomplete."""
    if result.method != "joint" or (
            result.model.terms and BESIDE not in result.extra.get(KEY, {})) \
            or max(result.artifact.m.size, result.plate.m.size) > MAX_FULL:
        return None
    system = system_behind(result)
    found = None if system is None else Together(result, system)
    return found if found is not None and found.marks.any() else None


def plate_covariance(result: CalibrationResult, known: np.ndarray) -> np.ndarray:
    """Return the covariance of Ax, Ay at marks, m^2.

    (2n, 2n), or the variances (2n,) if the correlations are not kept.
    """
    emap, kept = plate_as_map(result).error_map, together(result)
    if kept is None or not kept.marks[known].all():
        return np.concatenate([emap.u_gx[known], emap.u_gy[known]]) ** 2
    nowhere = np.zeros(kept.sites.shape, dtype=bool)
    return kept.cover(nowhere, known)[:-4, :-4]


def plate_theta_covariance(result: CalibrationResult, known: np.ndarray) -> np.ndarray:
    """Return the covariance of Atheta at lines, rad^2; variances if it is not kept."""
    u, kept = plate_as_map(result).error_map.u_g_theta, together(result)
    lines, cover = (np.zeros((2, 0)), u) if kept is None else kept.lines()
    if not lines.size or not lines[1][known].all():
        return u[known] ** 2
    at = len(u) + np.flatnonzero(known)
    return cover[np.ix_(at, at)]


def plate_as_map(result: CalibrationResult) -> CalibrationResult:
    """Return the result with the map of its plate in place of that of the stage."""
    found = result.artifact_map
    artifact = replace(result.plate, map_grid=None, harmonics=0)
    nothing, none = np.full(artifact.shape, np.nan), np.full(artifact.angular_count, np.nan)
    o, r = first_order(artifact, found.ax + 1j * found.ay)
    u_x, u_y, u_theta = (u if u.size else empty for u, empty in (
        (found.u_ax, nothing), (found.u_ay, nothing), (found.u_a_theta, none)))
    return replace(result, placed_plate=None, error_map=ErrorMap(
        artifact, found.ax, found.ay, u_x, u_y, found.a_theta, u_theta, o, r))
