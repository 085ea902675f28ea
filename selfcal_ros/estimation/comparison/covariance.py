# SPDX-License-Identifier: Apache-2.0
"""Covariances of saved maps, from the weights of the readings in RESULT.json.

They are exact, including reference length and terms of the model. Without weights, only the
variances of the map are known.

The joint covariance of the maps of stage and plate is exact for noise and terms of the model. What
else enlarges u (unequal noise, noise in time, stages read beside the sites) enlarges both maps in
the ratio in which it enlarges that of the stage; effects that are not terms enlarge the plate's by
as much as the stage's, at every mark by itself.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from selfcal_ros.compensation.circle import fourier_basis
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.datum.covariance import (
    LinesCovariance,
    MapsCovariance,
    conditions_for,
    lines_alone,
)
from selfcal_ros.estimation.joint.images import Images
from selfcal_ros.estimation.joint.problem import bounded_ratio
from selfcal_ros.estimation.joint.solve import factors_of
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.lattice.readings import Marks, in_field, pose_of
from selfcal_ros.estimation.normal.angular import MAX_FULL
from selfcal_ros.estimation.normal.equations import NormalEquations, system_of
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum
from selfcal_ros.model.kept import FACTORS, Covariance, Factors, ImagesKept, Kept
from selfcal_ros.model.readings import Sense, lines_turned_over, turned_over
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import block_of_offsets
from selfcal_ros.model.view import View, shared_rotations


def covariance_of(
    result: CalibrationResult,
    kind: str,
    known_places: np.ndarray,
    *,
    plate: bool = False,
) -> np.ndarray:
    """Return the covariance of the known values of a map, m^2 or rad^2.

    Parameters
    ----------
    result : CalibrationResult
        The result.
    kind : str
        ``xy``: Gx, then Gy; or ``theta``.
    known_places : bool array (nx, ny) or (K,)
        Sites or lines with an error.
    plate : bool
        Whether it is the map of the plate.

    Returns
    -------
    float array (n, n) or (n,)
        The covariance; the variances if the correlations are unknown.
    """
    emap = (plate_as_map(result) if plate else result).error_map
    u = emap.of(kind)[1][:, known_places].ravel()
    if plate:
        kept_parts = together(result)
        cover = None if kept_parts is None else kept_parts.of_plate(kind, known_places)
        return u**2 if cover is None else cover
    if kind in result.kept.covariances:
        return _stored(result, kind, known_places)
    factors = behind(result)
    if factors is None or not np.isfinite(u).all():
        return u**2
    if kind == "xy":
        cover = factors.of_sites(known_places)
        return u**2 if cover is None else _sized(cover, u)
    noise = factors.of_lines(known_places)
    if noise is None:
        return u**2
    of_terms = factors.terms_on_lines(known_places)
    u_noise = np.sqrt(np.maximum(u**2 - np.diag(of_terms), 0.0))
    return _sized(noise, u_noise) + of_terms


def unit_rows(known_sites: np.ndarray) -> np.ndarray:
    """Return the functionals Gx, then Gy, at the known sites, complex (2n, nx, ny)."""
    sites = np.flatnonzero(known_sites.ravel())
    rows = np.zeros((2 * len(sites), known_sites.size), dtype=complex)
    rows[np.arange(len(sites)), sites] = 1.0
    rows[len(sites) + np.arange(len(sites)), sites] = 1j
    return rows.reshape(-1, *known_sites.shape)


def kept_covariances(covers: Mapping[str, np.ndarray]) -> Kept:
    """Return covariances of the known values as a result keeps them, those that are not too large.

    Parameters
    ----------
    covers : dict
        ``xy``, Gx, then Gy, m^2, and ``theta``, rad^2 -> covariance (n, n).
    """
    return Kept(
        covariances={
            kind: Covariance.of(cover)
            for kind, cover in covers.items()
            if 0 < len(cover) <= MAX_FULL
        }
    )


def _stored(
    result: CalibrationResult, kind: str, known_places: np.ndarray
) -> np.ndarray:
    """Return the stored covariance of the known values, which are among those of the map."""
    values = result.error_map.of(kind)[0]
    in_map = np.isfinite(values).all(axis=0)
    try:
        full = result.kept.covariances[kind].matrix(len(values) * int(in_map.sum()))
    except ValueError as error:
        raise InputError(
            "map_covariance",
            "no covariance of this map",
            "write the map again with `selfcal combine`",
        ) from error
    chosen = np.tile(known_places[in_map], len(values))
    return full[np.ix_(chosen, chosen)]


def _sized(cover: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return a covariance with its correlations and the standard uncertainties `u`."""
    variances = np.diag(cover)
    size = u / np.sqrt(
        np.maximum(variances, max(1e-12 * variances.max(), np.finfo(float).tiny))
    )
    return cover * size[:, None] * size


def first_order_u(result: CalibrationResult) -> tuple[float, float]:
    """Return the standard uncertainties of O and R of a map; NaN if unknown.

    Of a large field the contribution of the terms is not kept, and noise alone would be too little.
    """
    unknown = float("nan"), float("nan")
    if result.kept.covariances:
        known_sites, pitch_m = result.error_map.valid, result.artifact.grid_pitch_m
        cover = covariance_of(result, "xy", known_sites)
        if cover.ndim == 1:
            return unknown
        z = (result.artifact.x_m + 1j * result.artifact.y_m) / pitch_m
        shear = Gauge(z, known_sites, scale=True).shear[:, known_sites]
        rows = np.concatenate([shear.real, shear.imag], axis=1)
        variance = np.diag(rows @ cover @ rows.T) / pitch_m**2
    else:
        factors = behind(result)
        if factors is None or factors.lacks_terms:
            return unknown
        shear = factors.system.gauge.shear
        saved = factors_of(result)
        row = turned_over(result.sense, shear).conj()
        along_x, along_y = saved.of_map[saved.of_fields].swapaxes(0, 1)
        common = along_x + 1j * along_y
        of_terms = np.real(np.tensordot(common, row, axes=((1, 2), (1, 2))))
        added = result.kept.added
        variance = (
            np.diag(factors.maps.of(shear))
            + (of_terms**2).sum(axis=0)
            + (0.0 if added is None else added)
        )
        variance = variance * result.noise.sigma_xy**2 * _noisier(result)
        of_each_place = variance_of_each_place(result)
        variance += (
            row.real**2 * of_each_place[0] + row.imag**2 * of_each_place[1]
        ).sum(axis=(1, 2))
        variance = variance / factors.half_width_m**2
    o, r = np.sqrt(variance)
    return float(o), float(r)


def _product(saved: Factors, known_sites: np.ndarray, first: int = 0) -> np.ndarray:
    """Return the covariance of Gx, then Gy, at sites by factors from the `first` on, (2n, 2n)."""
    factors = saved.of_map[first:][:, :, known_sites]
    factors = factors.reshape(len(factors), 2 * int(known_sites.sum()))
    fields = factors[saved.of_fields[first:]]
    cover = fields.T @ fields
    of_each_place = factors[saved.of_each_place[first:]]
    cover[np.diag_indices_from(cover)] += (of_each_place**2).sum(axis=0)
    return cover


def variance_of_each_place(result: CalibrationResult) -> np.ndarray:
    """Return the part of u^2 with a sign of its own at each place, (2, nx, ny) m^2."""
    saved = factors_of(result)
    of_each_place_m = saved.of_map[saved.of_each_place] * np.nan_to_num(
        result.noise.sigma_xy
    )
    return (of_each_place_m**2).sum(axis=0)


def _noisier(result: CalibrationResult) -> float:
    """Return the variance of noise and terms over what it is without views that are noisier."""
    saved = factors_of(result)
    more = (saved.of_map[saved.of_size] ** 2).sum()
    if not more:
        return 1.0
    stated = np.nansum(result.error_map.u_xy**2) / result.noise.sigma_xy**2
    effects = (saved.of_map[saved.with_map :] ** 2).sum()
    return float(1 + more / (stated - effects))


def system_behind(result: CalibrationResult) -> NormalEquations | None:
    """Return the system of the weights in a result; None if unknown or not identified."""
    if (
        np.isnan(result.error_map.u_gx).all()
        or not result.observability.identifiable
        or result.recheck is not None
        or not result.views
        or any(v.read_grid is None or v.read_angular is None for v in result.views)
    ):
        return None
    artifact = result.plate
    grid, lines = [], []
    for index, v in enumerate(result.views):
        in_grid = _is_read(v.read_grid)
        of_grid = f"view '{v.name}', read.grid"
        view = View(
            v.name,
            v.rotation,
            (v.translation_x, v.translation_y),
            in_grid,
            _is_read(v.read_angular),
        )
        pose = pose_of(view, artifact)
        field = np.ones(artifact.angular_count)
        weight = _weights(v.read_angular, field, f"view '{v.name}', read.angular")
        if weight.any():
            turned = v.phi if artifact.harmonics and np.isfinite(v.phi) else 0.0
            turned *= artifact.angular_count / (2 * np.pi)
            lines.append((index, (pose.turn_lines or 0) + turned, weight))
        if in_grid:
            grid.append(
                (index, pose, _weights(v.read_grid, in_field(view, artifact), of_grid))
            )
    angular = np.array([weight for *_, weight in lines]).reshape(
        len(lines), artifact.angular_count
    )
    return system_of(
        Marks(
            tuple(at for _, at, _ in grid),
            np.array([weight for *_, weight in grid]),
            tuple(index for index, *_ in grid),
            rotations=kept_rotations(result, len(grid)),
            plate=artifact.placed,
        ),
        Marks(
            tuple(turn for _, turn, _ in lines),
            angular,
            tuple(index for index, *_ in lines),
            artifact.harmonics,
        ),
    )


def share_of(result: CalibrationResult) -> float:
    """Return the part of the variance of a reading that the marks of an image share; 0 without."""
    return 0.0 if result.kept.images is None else result.kept.images.share


def kept_rotations(result: CalibrationResult, n_views: int) -> tuple[int, ...]:
    """Return the first of the grid views that have the rotation of each, see `rotations_of`."""
    if result.kept.images is None:
        return tuple(range(n_views))
    placings, steps = zip(*_cells_of_views(result.kept.images, n_views), strict=True)
    return shared_rotations([placings.index(number) for number in placings], steps)


def _cells_of_views(
    images: ImagesKept, n_views: int
) -> list[tuple[int, tuple[int, int]]]:
    """Return the placing of the plate in each grid view of a result, and the step of its cell."""
    if not len(images.placing) == len(images.step) == n_views:
        raise InputError(
            "images",
            "no images of these views",
            "write the result again with `selfcal solve`",
        )
    return list(zip(images.placing, images.step, strict=True))


def _is_read(weights: Any) -> bool:
    """Return whether any weight is not zero; NaN counts, and is refused with the weights."""
    try:
        return bool(np.any(np.array(weights, dtype=float)))
    except (TypeError, ValueError):
        return True


def _weights(weights: Any, field: np.ndarray, where: str) -> np.ndarray:
    """Return weights in full: a single number stands for the whole field.

    Raises
    ------
    InputError
        If they are not weights of this field.
    """
    shape = field.shape if isinstance(weights, list | np.ndarray) else ()
    try:
        weight = np.array(weights, dtype=float).reshape(shape) * (
            field if shape == () else 1.0
        )
    except (TypeError, ValueError):
        weight = np.array(np.nan)
    if not (np.isfinite(weight) & (weight >= 0)).all():
        raise InputError(
            where,
            "no weights of this field",
            "write the result again with `selfcal solve`",
        )
    return weight


def _missing_error(missing: str) -> InputError:
    """Return the error of a result whose factors do not have what belongs to them."""
    return InputError(
        FACTORS, f"no {missing}", "write the result again with `selfcal solve`"
    )


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

    @property
    def lacks_terms(self) -> bool:
        """Whether the uncertainty has contributions of terms that the result does not keep."""
        return bool(self.result.model.terms and self.result.kept.factors is None)

    @property
    def half_width_m(self) -> float:
        """The longer half width of the plate, m."""
        return self.result.plate.half_width_m

    @cached_property
    def maps(self) -> MapsCovariance:
        """Covariance of both maps for unit noise, without terms of the model."""
        result, system = self.result, self.system
        noise, length = result.noise, self.half_width_m
        ratio = (
            bounded_ratio(system, noise.sigma_xy, noise.sigma_theta, length)
            if system.angular.n_views
            else 1.0
        )
        return MapsCovariance(
            system,
            system.inverse(ratio),
            result.reference,
            half_width_m=length,
            sigma_m=noise.sigma_xy,
        )

    @cached_property
    def _images(self) -> Images | None:
        """The images; None without images."""
        if not share_of(self.result):
            return None
        grid = self.system.grid
        cells_of_views = _cells_of_views(
            cast(ImagesKept, self.result.kept.images), grid.n_views
        )
        return Images.of(grid, cells_of_views)

    def stage_rows(self, known_sites: np.ndarray) -> np.ndarray:
        """Return the functionals Gx, then Gy, at sites, in the frame of the equations."""
        return turned_over(self.result.sense, unit_rows(known_sites))

    def of_noise(
        self, sites: np.ndarray, marks: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the covariance of functionals of both maps for noise of marks and images."""
        cover = self.maps.of(sites, marks)
        if self._images is None:
            return cover
        return cover + share_of(self.result) * self._images.added_covariance(
            self.maps.sensitivities(sites, marks)
        )

    def of_sites(self, known_sites: np.ndarray) -> np.ndarray | None:
        """Return the covariance of Gx, then Gy, at sites for unit noise, None if it is not kept."""
        if known_sites.size > MAX_FULL or self.lacks_terms:
            return None
        return self.of_noise(self.stage_rows(known_sites)) + _product(
            self._saved, known_sites
        )

    def of_lines(self, known_lines: np.ndarray) -> np.ndarray | None:
        """Return the covariance of Gtheta at lines for their unit noise, None if it is not kept."""
        if len(known_lines) > MAX_FULL or not self.system.angular.n_views:
            return None
        rows = self._line_rows(known_lines)
        return lines_alone(self.system).of(rows.T, np.zeros(rows.T.shape))

    def _line_rows(self, known_lines: np.ndarray) -> np.ndarray:
        """Return the functionals Gtheta, in its datum, at lines, frame of the equations, (n, K)."""
        result = self.result
        conditions = conditions_for(
            self.system,
            ThetaDatum(result.error_map.datum_theta),
            Sense(result.sense),
            self.half_width_m,
        )
        to_datum = np.eye(len(known_lines)) - conditions.gain @ conditions.rows
        return lines_turned_over(result.sense, to_datum)[known_lines]

    def terms_on_lines(
        self, known_lines: np.ndarray, names: Collection[str] | None = None
    ) -> np.ndarray:
        """Return the covariance of Gtheta, in its datum, by terms and effects, (n, n) rad^2.

        What has no factors has a sign of its own at each line, as far as a Fourier map can have it.

        Parameters
        ----------
        known_lines : bool array (K,)
            Lines.
        names : collection of str, optional
            Only of these, and of terms whose names an older file does not say.
        """
        result, saved = self.result, self._saved
        factors = self._saved_factors("lines", (2, len(known_lines)))[:, 0]
        rows = self._line_rows(known_lines) @ lines_turned_over(result.sense, factors.T)
        rows = rows.T * (np.nan_to_num(result.noise.sigma_xy) / self.half_width_m)
        with_rows = {term.name for term in result.model.terms} if len(rows) else set()
        if names is not None:
            chosen = np.ones(len(rows), dtype=bool)
            named = (*saved.terms[: saved.with_map], *saved.beside_terms)
            chosen[: len(named)] = np.isin(named, list(names))
            rows = rows[chosen]
        of_each_line = np.zeros(int(known_lines.sum()))
        for name, u in result.kept.angular.items():
            if name not in with_rows and (names is None or name in names):
                of_each_line += u[known_lines] ** 2
        return rows.T @ rows + self._in_map(np.diag(of_each_line), known_lines)

    def _in_map(self, cover: np.ndarray, known_lines: np.ndarray) -> np.ndarray:
        """Return the part of a covariance of lines, (n, n), that a map of harmonics can have."""
        harmonics = self.result.plate.harmonics
        if not harmonics:
            return cover
        angle = 2 * np.pi * np.flatnonzero(known_lines) / len(known_lines)
        basis = np.linalg.qr(fourier_basis(angle, harmonics)[:, 1:])[0]
        projector = basis @ basis.T
        return projector @ cover @ projector

    def of_plate(self, kind: str, known_places: np.ndarray) -> np.ndarray | None:
        """Return the covariance of the plate's map, ``xy`` or ``theta``, None if it is not kept."""
        if kind == "xy":
            nowhere = np.zeros(self.sites.shape, dtype=bool)
            return (
                self.cover(nowhere, known_places)[:-4, :-4]
                if self.marks[known_places].all()
                else None
            )
        lines, cover = self.lines()
        lines_of_plate = len(known_places) + np.flatnonzero(known_places)
        return (
            cover[np.ix_(lines_of_plate, lines_of_plate)]
            if lines[1][known_places].all()
            else None
        )

    @property
    def _saved(self) -> Factors:
        return factors_of(self.result)

    @property
    def _effects(self) -> np.ndarray:
        """Effects that are not terms of the model, for unit noise, (e, 2, nx, ny)."""
        effects = np.arange(len(self._saved.terms)) >= self._saved.with_map
        return self._saved.of_map[effects & ~self._saved.of_size]

    @property
    def _effects_on_plate(self) -> np.ndarray:
        """What they add to the variance of the plate's map, for unit noise, (2, nx, ny)."""
        added = self._saved.on_plate
        if added is None and len(self._effects):
            raise _missing_error("effects on the plate")
        return np.zeros((2, *self.marks.shape)) if added is None else added

    def _saved_factors(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return the factors of a quantity beside the map in this shape, (r, ...)."""
        saved = self._saved.beside
        if saved and name not in saved:
            raise _missing_error(f"{name} of this plate")
        return saved.get(name, np.zeros((0, *shape))).reshape(-1, *shape)

    def _factors(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the effect of terms on G, A and the microscope, (r, q)."""
        plate = self._saved_factors("plate", (2, *marks.shape))
        n = self._saved.with_map
        stage = self._saved.of_map[:n]
        n_of_stage = 2 * int(sites.sum())
        r = len(plate)
        maps = np.zeros((r, n_of_stage + 2 * int(marks.sum()) + 4))
        maps[:n, :n_of_stage] = stage[:, :, sites].reshape(n, n_of_stage)
        maps[:, n_of_stage:-4] = plate[:, :, marks].reshape(
            r, maps.shape[1] - n_of_stage - 4
        )
        maps[:, -4:] = (
            self._saved_factors(block_of_offsets().name, (4,)) / self.half_width_m
        )
        return maps

    def cover(self, sites: np.ndarray, marks: np.ndarray) -> np.ndarray:
        """Return the covariance of Gx, Gy at sites, Ax, Ay at marks, and the microscope.

        Float (2 s + 2 m + 4, ...), m^2; the microscope's (scale, turn, stretch, shear) in m/m.

        Parameters
        ----------
        sites, marks : bool array (nx, ny)
            Of the known ones.
        """
        s, m = 2 * int(sites.sum()), 2 * int(marks.sum())
        rows_g = self.stage_rows(sites)
        rows_a = unit_rows(marks)
        exact = np.zeros((s + m + 4, s + m + 4))
        exact[:-4, :-4] = self.of_noise(
            np.concatenate([rows_g, np.zeros((m, *rows_g.shape[1:]))]),
            np.concatenate([np.zeros((s, *rows_a.shape[1:])), rows_a]),
        )
        factors = self._factors(sites, marks)
        cover = exact + factors.T @ factors
        if self._images is None:
            cover[:-4, :-4] *= self._ratio
        else:  # their noise moves the stage's map much and the plate's little
            root = np.sqrt(
                np.repeat([self._ratio, self._ratio_of_plate, 1.0], [s, m, 4])
            )
            cover *= np.outer(root, root)
        cover[:s, :s] += _product(self._saved, sites, self._saved.with_map)
        if len(self._effects):
            cover[range(s, s + m), range(s, s + m)] += self._effects_on_plate[
                :, marks
            ].ravel()
        return cover * self.result.noise.sigma_xy**2

    @cached_property
    def _ratio(self) -> float:
        """Variance of the stage's map over that of white noise and terms."""
        emap = self.result.error_map
        sites = self.sites
        white = np.trace(self.of_noise(self.stage_rows(sites)))
        factors = self._saved.of_map[~self._saved.of_size]
        white += (factors[..., sites] ** 2).sum()
        effects = (self._effects[..., sites] ** 2).sum()
        stated = (emap.u_gx[sites] ** 2 + emap.u_gy[sites] ** 2).sum()
        sigma = max(self.result.noise.sigma_xy, np.finfo(float).tiny)
        return float(max((stated / sigma**2 - effects) / (white - effects), 0.0))

    @cached_property
    def _ratio_of_plate(self) -> float:
        """The same for the plate's map, on which noise of images acts differently."""
        plate = self.result.artifact_map
        marks = self.marks
        rows = unit_rows(marks)
        white = np.trace(self.of_noise(np.zeros((len(rows), *self.sites.shape)), rows))
        white += (
            self._saved_factors("plate", (2, *marks.shape))[..., marks] ** 2
        ).sum()
        stated = (plate.u_ax[marks] ** 2 + plate.u_ay[marks] ** 2).sum()
        stated -= self._effects_on_plate[:, marks].sum() * self.result.noise.sigma_xy**2
        return float(
            stated / white / max(self.result.noise.sigma_xy, np.finfo(float).tiny) ** 2
        )

    def lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lines known in both angular maps, bool (2, K), and their covariance, rad^2.

        (2 K, 2 K), the maps without their means over these lines; 0 elsewhere.
        """
        result = self.result
        angular = self.system.angular
        count, emap, plate = angular.n_lines, result.error_map, result.artifact_map
        known_lines = np.isfinite(
            np.stack([emap.g_theta + emap.u_g_theta, plate.a_theta + plate.u_a_theta])
        )
        if not angular.n_views or count > MAX_FULL or not known_lines.any(axis=1).all():
            return np.zeros((2, count), dtype=bool), np.zeros((2 * count, 2 * count))
        centre = np.zeros((2 * count, 2 * count))
        for map_number, of_map in enumerate(known_lines):
            rows = map_number * count + np.flatnonzero(of_map)
            centre[np.ix_(rows, rows)] = np.eye(len(rows)) - 1 / len(rows)
        stage = lines_turned_over(result.sense, centre[:, :count].T)
        noise = result.noise
        cover = LinesCovariance(self.maps, (noise.sigma_xy, noise.sigma_theta)).of(
            stage, centre[:, count:].T
        )
        terms = (
            self._saved_factors("lines", (2 * count,))
            @ centre.T
            * (noise.sigma_xy / self.half_width_m)
        )
        cover = cover + terms.T @ terms
        white = np.diag(cover)[:count][known_lines[0]].sum()
        stated = (emap.u_g_theta[known_lines[0]] ** 2).sum()
        return known_lines, cover * max(float(stated / white), 1.0)


def behind(result: CalibrationResult) -> Together | None:
    """Return the covariances behind a result; None if its readings are not kept."""
    system = system_behind(result)
    return None if system is None else Together(result, system)


def together(result: CalibrationResult) -> Together | None:
    """Return the joint covariance of stage and plate of a result; None if it is incomplete."""
    incomplete = result.model.terms and not factors_of(result).beside
    if incomplete or max(result.artifact.m.size, result.plate.m.size) > MAX_FULL:
        return None
    factors = behind(result)
    return factors if factors is not None and factors.marks.any() else None


def plate_as_map(result: CalibrationResult) -> CalibrationResult:
    """Return the result with the map of its plate in place of that of the stage."""
    plate_map = result.artifact_map
    artifact = replace(result.plate, map_grid=None, harmonics=0)
    nothing, none = (
        np.full(artifact.shape, np.nan),
        np.full(artifact.angular_count, np.nan),
    )
    u_x, u_y, u_theta = (
        u if u.size else empty
        for u, empty in (
            (plate_map.u_ax, nothing),
            (plate_map.u_ay, nothing),
            (plate_map.u_a_theta, none),
        )
    )
    emap = ErrorMap.of_maps(
        artifact,
        (np.stack([plate_map.ax, plate_map.ay]), np.stack([u_x, u_y])),
        (plate_map.a_theta, u_theta),
    )
    return replace(result, placed_plate=None, error_map=emap)
