# SPDX-License-Identifier: Apache-2.0
"""The camera's distortion and the stage's yaw from images of several marks (method eq. 4.16).

The offset of each cell of the image holds the camera's error there. A polynomial through the cells
straightens offsets between them; its degree is the smallest that the cells do not contradict.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.checks.wiring import with_offsets
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import F_LEVEL, NEGLIGIBLE
from selfcal_ros.estimation.normal.angular import MAX_STEPS
from selfcal_ros.estimation.normal.equations import TRACE
from selfcal_ros.estimation.observability.rank import DETERMINED
from selfcal_ros.estimation.terms.equations import next_coefficients
from selfcal_ros.model.camera import CameraCell, CameraErrors, CameraPower, StageYawMap
from selfcal_ros.model.error_map import MANY_DOF
from selfcal_ros.model.findings import FewRead, FewReadCell, Finding
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import GridVisits, Measurements, Sense, ViewReadings
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.view import View

POWERS = {1: ((1, 0), (0, 1)), 2: ((2, 0), (1, 1), (0, 2)), 3: ((2, 1),)}
"""Powers (a, b) of z^a conj(z)^b that each degree adds; radial distortion is z^2 conj(z). The other
cubic ones look like linear ones in three cells."""

STEP_M = 1e-6
"""Half the distance over which the slope of the distortion is taken, small in any camera."""

Powers = Sequence[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Distortion:
    """Errors of a camera as a polynomial: published minus true offset, by the true one.

    Attributes
    ----------
    powers : sequence of tuple
        Of the polynomial, see `POWERS`.
    coefficients : complex array (1 + powers,)
        Its constant, 0, and its coefficients, places and errors in m.
    """

    powers: Powers
    coefficients: np.ndarray

    @property
    def places(self) -> dict[tuple[int, int], complex]:
        """Mean published offset in each cell where it was measured, m."""
        return {}

    def at(self, offset: np.ndarray) -> np.ndarray:
        """Return the error at published offsets, complex, m: that at the true ones."""
        error = np.zeros_like(offset)
        for _ in range(MAX_STEPS):
            before = error
            error = _terms(offset - error, self.powers) @ self.coefficients
            if np.array_equal(error, before):
                break
        return error


@dataclass(frozen=True, eq=False)
class FittedCamera(Distortion):
    """Errors of a camera: published minus true offset, as a function of the true one.

    Attributes
    ----------
    image : Image
        All cells.
    cells : sequence of tuple
        Those whose error is known, in their order.
    place, error : complex array (cells,)
        Mean true offset in each known cell, stage axes, and the error there relative to that on
        the optical axis, m.
    u : float array (cells, 2)
        Standard uncertainties of the errors along x and y, m.
    u_coefficients : float array (1 + powers, 2)
        Standard uncertainties of their real and imaginary parts.
    noise_image, noise_mark : float
        Noise shared by the marks of an image, and that of a mark, m.
    """

    image: ImageCells
    cells: Sequence[tuple[int, int]]
    place: np.ndarray
    error: np.ndarray
    u: np.ndarray
    u_coefficients: np.ndarray
    noise_image: float
    noise_mark: float

    @property
    def places(self) -> dict[tuple[int, int], complex]:
        """Mean published offset in each known cell, m."""
        return dict(zip(self.cells, self.place + self.error, strict=True))

    @property
    def as_result(self) -> CameraErrors:
        """What a result keeps of it."""
        scale, shear = self.coefficients[1:3]
        u_scale, u_turn = self.u_coefficients[1]
        cells_by_place = {
            cell: CameraCell(z.real, z.imag, e.real, e.imag, *u)
            for cell, z, e, u in zip(
                self.cells, self.place, self.error, self.u, strict=True
            )
        }
        return CameraErrors(
            scale=scale.real,
            rotation=scale.imag,
            stretch=shear.real,
            shear=shear.imag,
            u_scale=u_scale,
            u_rotation=u_turn,
            u_stretch=self.u_coefficients[2, 0],
            u_shear=self.u_coefficients[2, 1],
            degree=max(a + b for a, b in self.powers),
            coefficients=tuple(
                CameraPower(tuple(power), value.real, value.imag, *u)
                for power, value, u in zip(
                    self.powers,
                    self.coefficients[1:],
                    self.u_coefficients[1:],
                    strict=True,
                )
            ),
            cells=tuple(
                cells_by_place.get(cell)
                or CameraCell(
                    *(step * self.image.pitch_m for step in cell), *[math.nan] * 4
                )
                for cell in self.image.cells
            ),
            noise_image=self.noise_image,
            noise_mark=self.noise_mark,
        )


def _terms(z: np.ndarray, powers: Powers) -> np.ndarray:
    """Return 1 and the powers of places, complex (..., 1 + powers)."""
    power = [np.ones_like(z)]
    for _ in range(max(map(max, powers), default=0)):
        power.append(power[-1] * z)
    return np.stack(
        [power[0], *(power[a] * power[b].conj() for a, b in powers)], axis=-1
    )


def camera_of(measurements: Measurements, model: ModelFit) -> FittedCamera | None:
    """Return the camera that a fit shows; None if its cells are too few, or lie in one line.

    A cell that one view lacks has the error that the others show, as they differ between cells.
    """
    images = model.problem.images
    if images is None:
        return None
    problem = model.problem
    grid = model.problem.system.grid
    readings = [measurements.views[index] for index in problem.grid.index]
    image = readings[0].view.image
    if image is None or min(image.nx, image.ny) < 3:
        return None

    def offsets(parameters: np.ndarray) -> np.ndarray:
        """Return the offsets of the sub-views for misalignments (..., size)."""
        return problem.to_stage * (
            parameters[..., 1 : 3 * grid.n_views : 3]
            + 1j * parameters[..., 2 : 3 * grid.n_views : 3]
        )

    noises = images.noises(model.fitted.residuals)
    drawn = offsets(images.parameters)
    layout = _layout(
        [view_readings.view for view_readings in readings],
        image,
        grid.read.sum(axis=(1, 2)) > 1,
    )
    if layout is None:
        return None
    cells, rows, errors = layout
    error_of_cell = errors(offsets(model.fitted.parameters))
    drawn = errors(drawn)
    samples = noises.mark * drawn[:, 0] + noises.image * drawn[:, 1]
    published = np.array(
        [_place([readings[row] for row in column[column >= 0]]) for column in rows.T]
    )
    if not _determined(published, POWERS[1]):
        return None
    error = error_of_cell
    # from the optical axis on, not from the offsets in its cell
    for _ in range(MAX_STEPS):
        before = error
        powers, fit = _polynomial(published - error, error_of_cell, samples)
        error = error_of_cell - (fit @ error_of_cell)[0]
        if np.array_equal(error, before):
            break
    drawn_corrections = samples @ fit.T
    return FittedCamera(
        powers=powers,
        coefficients=fit @ error,
        image=image,
        cells=cells,
        place=published - error,
        error=error,
        u=_spread(samples - drawn_corrections[:, :1]),
        u_coefficients=_spread(drawn_corrections),
        noise_image=noises.image,
        noise_mark=noises.mark,
    )


Layout = tuple[list[tuple[int, int]], np.ndarray, Callable[[np.ndarray], np.ndarray]]
"""Cells, the sub-view of each view in each of them, int array (names, cells), -1 for none, and a
function from offsets (..., views) to those of cells relative to the one nearest the axis."""


def _layout(
    views: Sequence[View], image: ImageCells, usable: np.ndarray
) -> Layout | None:
    """Return how offsets of sub-views, those `usable`, depend on view and cell.

    A gap has the value that the least squares of both effects give it, so that means over the
    views are the estimates. None if the views do not connect the cells.
    """
    row_of = {
        (views[row].plan_view, views[row].cell): row
        for row in np.flatnonzero(usable).tolist()
    }
    names = list(dict.fromkeys(name for name, _ in row_of))
    cells = [
        cell for cell in image.cells if any((name, cell) in row_of for name in names)
    ]
    rows = np.array(
        [[row_of.get((name, cell), -1) for cell in cells] for name in names]
    )
    effects = np.concatenate(
        [
            np.repeat(np.eye(len(names)), len(cells), axis=0),
            np.tile(np.eye(len(cells)), (len(names), 1)),
        ],
        axis=1,
    )
    is_read = rows >= 0
    if np.linalg.matrix_rank(effects[is_read.ravel()]) < len(names) + len(cells) - 1:
        return None
    gaps = effects[~is_read.ravel()] @ np.linalg.pinv(effects[is_read.ravel()])
    middle = min(range(len(cells)), key=lambda index: abs(complex(*cells[index])))

    def errors(offset: np.ndarray) -> np.ndarray:
        of_cell = offset[..., rows]
        of_cell[..., ~is_read] = of_cell[..., is_read] @ gaps.T
        return (of_cell - of_cell[..., middle, None]).mean(axis=-2)

    return cells, rows, errors


def _spread(samples: np.ndarray) -> np.ndarray:
    """Return the standard deviations of real and imaginary parts of draws (k, n), (n, 2)."""
    return np.stack(
        [samples.real.std(axis=0, ddof=1), samples.imag.std(axis=0, ddof=1)], axis=1
    )


def _polynomial(
    place: np.ndarray, error: np.ndarray, samples: np.ndarray
) -> tuple[Powers, np.ndarray]:
    """Return the powers of a polynomial, and the matrix from errors to its coefficients.

    A degree is taken if its coefficients differ from 0 by more than those of draws (Hotelling).
    """
    powers: tuple[tuple[int, int], ...] = POWERS[1]
    fit = _fitted(place, powers)
    for degree in (3, 2):
        wider_powers = (*powers, *POWERS[degree])
        if not _determined(place, wider_powers):
            continue
        wider = _fitted(place, wider_powers)
        added = (wider @ error)[len(powers) + 1 :]
        drawn = (samples @ wider.T)[:, len(powers) + 1 :]
        drawn_parts = np.concatenate([drawn.real, drawn.imag], axis=1)
        value = np.concatenate([added.real, added.imag])
        k, n = drawn_parts.shape
        squares = value @ np.linalg.solve(drawn_parts.T @ drawn_parts / k, value)
        if fdtrc(n, k - n, squares * (k - n) / (n * (k - 1))) < F_LEVEL:
            powers, fit = wider_powers, wider
    return powers, fit


def _fitted(place: np.ndarray, powers: Powers) -> np.ndarray:
    """Return the least-squares matrix from errors at the cells to coefficients, complex."""
    scale = float(np.abs(place).max())
    unit = np.array([1.0, *(scale ** (a + b) for a, b in powers)])
    return np.linalg.pinv(_unit_terms(place, powers)) / unit[:, None]


def _unit_terms(place: np.ndarray, powers: Powers) -> np.ndarray:
    """Return 1 and the powers of places, the farthest at 1."""
    return _terms(place / float(np.abs(place).max()), powers)


def _determined(place: np.ndarray, powers: Powers) -> bool:
    """Return whether a polynomial follows from its values at places, not all near one line."""
    sizes = np.linalg.svd(_unit_terms(place, powers), compute_uv=False)
    return bool(len(sizes) > len(powers) and sizes[-1] > NEGLIGIBLE * sizes[0])


def _place(views: Sequence[ViewReadings]) -> complex:
    """Return the mean published offset in a cell, stage axes, m."""
    return complex(
        np.mean(
            [
                view.view.cell_m
                + (view.visits.offset_x + 1j * view.visits.offset_y).mean()
                for view in views
                if view.visits is not None
            ]
        )
    )


def straightened(measurements: Measurements, camera: Distortion) -> Measurements:
    """Return the readings with the camera's error in each cell that of its mean offset.

    Or that of its nominal place, if the camera was found from other readings, or without the cell.
    """
    places = camera.places
    return replace(
        measurements,
        views=tuple(
            view
            if view.view.cell is None or view.visits is None
            else _straight(
                view, view.visits, camera, places.get(view.view.cell, view.view.cell_m)
            )
            for view in measurements.views
        ),
    )


def known_camera(result: CalibrationResult) -> Distortion | None:
    """Return the camera that a calibration found; None if it found none."""
    if result.camera is None:
        return None
    return Distortion(
        [
            (a, b)
            for a, b in (
                coefficient.power for coefficient in result.camera.coefficients
            )
        ],
        np.array(
            [
                0,
                *(
                    complex(coefficient.x, coefficient.y)
                    for coefficient in result.camera.coefficients
                ),
            ]
        ),
    )


def _straight(
    view: ViewReadings, visits: GridVisits, camera: Distortion, place: complex
) -> ViewReadings:
    offset = view.view.cell_m + visits.offset_x + 1j * visits.offset_y
    excess = camera.at(offset) - camera.at(np.array([place]))
    return with_offsets(view, visits, -excess, straight_slope(camera, place))


def straight_slope(camera: Distortion, place: complex) -> np.ndarray:
    """Return the slope of straightened offsets on published ones at a place, float (2, 2)."""
    step = STEP_M * np.array([1, 1j])
    slope = (camera.at(place + step) - camera.at(place - step)) / (2 * STEP_M)
    return np.eye(2) - np.stack([slope.real, slope.imag])


def few_read(
    measurements: Measurements, camera: FittedCamera | None
) -> Iterator[Finding]:
    """Yield a finding on the cells of images whose mark is missing in most images.

    Those of all views together, or of one.
    """
    few = []
    counts = _read_and_shown(measurements)
    for cell in dict.fromkeys(cell for _, cell in counts):
        of_views = {
            name: count
            for (name, cell_of_count), count in counts.items()
            if cell_of_count == cell
        }
        total = np.sum(list(of_views.values()), axis=0)
        few += [
            (name, cell, count)
            for name, count in (
                [("", total)] if total[0] < DETERMINED * total[1] else of_views.items()
            )
            if count[0] < DETERMINED * count[1]
        ]
    if not few:
        return
    unknown = (
        None
        if camera is None
        else tuple(cell for cell in camera.image.cells if cell not in camera.cells)
    )
    cells = tuple(
        FewReadCell(view=name, cell=cell, read=int(n_read), shown=int(n_shown))
        for name, cell, (n_read, n_shown) in few
    )
    yield FewRead(unknown=unknown, cells=cells)


def _read_and_shown(
    measurements: Measurements,
) -> dict[tuple[str, tuple[int, int]], tuple[int, int]]:
    """Return for views and cells how many marks were read, and how many the images showed."""
    stops: dict[str, set[tuple[int, int]]] = {}
    sub_views = [
        (
            view_readings.view.plan_view,
            view_readings.view.cell,
            view_readings.view.step_on_plate(measurements.artifact),
            view_readings,
        )
        for view_readings in measurements.views
        if view_readings.view.cell is not None
    ]
    for name, _, (m, n), view_readings in sub_views:
        stops.setdefault(name, set()).update(
            zip(
                (view_readings.m - m).tolist(),
                (view_readings.n - n).tolist(),
                strict=True,
            )
        )
    (first_m, last_m), (first_n, last_n) = measurements.artifact.limits
    return {
        (name, cell): (
            len(view_readings.m),
            sum(
                first_m <= i + m <= last_m and first_n <= j + n <= last_n
                for i, j in stops[name]
            ),
        )
        for name, cell, (m, n), view_readings in sub_views
    }


def yaw_of(model: ModelFit, sense: Sense) -> StageYawMap | None:
    """Return the stage's yaw that a fit shows, whatever size it was given (method eq. 4.17).

    None without images, or if they do not determine it up to its mean.
    """
    images, inputs = model.problem.images, model.problem.inputs
    name = next(
        (term.name for term in model.problem.terms if term.block.of_images), None
    )
    if images is None or name is None:
        return None
    free = replace(
        model.equations, columns=model.equations.columns.scaled(name, math.inf)
    )
    rows = free.rows([name]) & (free.norm > free.norm.max() * TRACE)
    rows_of_yaw = rows[free.rows([name])]
    if np.linalg.matrix_rank(free.undetermined(free.free)[rows], tol=TRACE) > 1:
        return None
    noise = model.fitted.xy
    coefficients = model.coefficients
    now = model.scored(free, coefficients)
    inverse = free.inverse(noise.sigma)
    values = next_coefficients(
        free, now, coefficients, sigma_m=noise.sigma, inverse=inverse
    )
    centred = np.eye(int(rows.sum())) - 1 / rows.sum()
    to_map = centred @ inverse[rows]
    share = images.noises(model.fitted.residuals).share
    grid = free.system.grid
    fit = free.projected
    sensitivities = grid.plate(
        np.tensordot(to_map, free.columns.grid, axes=1),
        (to_map @ fit.fields.T).reshape(-1, *grid.views.shape),
        to_map @ fit.parameters[: 3 * grid.n_views].T,
    )[1]
    covariance = to_map[:, rows] @ centred + share * images.added_covariance(
        sensitivities
    )
    covariance *= noise.sigma**2
    yaw_rad = centred @ values[rows]
    n = len(centred) - 1
    statistic = (
        yaw_rad @ np.linalg.pinv(covariance, hermitian=True, rcond=1e-9) @ yaw_rad
    )
    x, y = (
        sense.sign * axis.ravel()[rows_of_yaw]  # (1.6) and its rotations
        for axis in np.meshgrid(*inputs.node_axes_m, indexing="ij")
    )
    return StageYawMap(
        x,
        y,
        sense.sign * yaw_rad,
        np.sqrt(np.diag(covariance)),
        float(fdtrc(n, min(noise.dof, MANY_DOF), statistic / n)),
    )
