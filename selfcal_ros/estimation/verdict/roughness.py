# SPDX-License-Identifier: Apache-2.0
"""Test whether the nodes of a map resolve the stage's errors, and size the lack of fit.

Between its nodes a map is a spline, and a stage that is rougher has more than that. A spline with
twice as many intervals contains the map's; with the same readings it must not fit significantly
better (F-test of its further coefficients, method eq. 12.4). What both differ by beyond their noise
is the lack of fit, a part of the uncertainty at the nodes and between them (eq. 12.5).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from scipy.linalg import qr
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.model_fit import (
    ModelFit,
    placed,
    with_map,
)
from selfcal_ros.estimation.joint.problem import F_LEVEL
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.lattice.maps import MapSpline
from selfcal_ros.estimation.normal.angular import FLOOR, AngularSystem, HarmonicSystem
from selfcal_ros.estimation.normal.equations import GAP, PlacedEquations, grid_residuals
from selfcal_ros.estimation.verdict.uncertainty import Effect, effect_everywhere
from selfcal_ros.model.artifact import Interpolation
from selfcal_ros.model.findings import Cause, CauseDetails
from selfcal_ros.model.kept import ROUGHNESS as NAME
from selfcal_ros.model.plate_form import with_nodes
from selfcal_ros.model.readings import Measurements, turned_over
from selfcal_ros.model.result import CalibrationResult

SIZES = (1e-2, 1e6, 65)
"""Trial sizes of the further coefficients, over the noise of the best one, and their number."""


@dataclass(frozen=True)
class Adequacy:
    """The test of a map's nodes.

    Attributes
    ----------
    p : float
        Probability of such an improvement by chance.
    lack : float
        Standard uncertainty from the lack of fit: one coordinate, m, or of the angular map, rad.
    local : float array (2, nx, ny)
        That of the nodes for themselves, frame of the equations, m; empty for the angular map.
    coefficients : float
        Further coefficients that the readings determine.
    nodes : tuple of int
        Nodes of the map along x and y; of the angular map, its harmonics.
    """

    p: float
    lack: float
    coefficients: float
    nodes: tuple[int, ...]
    local: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def of_lines(self) -> bool:
        """Whether it is that of the angular map."""
        return len(self.nodes) == 1

    def effect(self, result: CalibrationResult) -> Effect:
        """Return the lack of fit as an effect on every known node, or line."""
        emap = result.error_map
        if self.of_lines:
            return effect_everywhere(NAME, emap, size_rad=self.lack)
        local = turned_over(result.sense, self.local, sign=1)
        return effect_everywhere(NAME, emap, size_m=np.maximum(self.lack, local))

    @property
    def cause(self) -> Cause | None:
        """The cause `roughness`, if the map does not suffice."""
        if not self.p < F_LEVEL:
            return None
        map_size = (
            CauseDetails(harmonics=self.nodes[0])
            if self.of_lines
            else CauseDetails(nodes=self.nodes)
        )
        return Cause(
            name=NAME,
            size=self.lack,
            u=0.0,
            unit="rad" if self.of_lines else "m",
            p=self.p,
            effect_rms=self.lack,
            effect_max=self.lack,
            details=map_size,
        )


def adequacy_of(model: ModelFit) -> Adequacy | None:
    """Return the test of the map of a fit.

    None on the lattice, for a map that is too large, or if the readings are too few for a finer
    one.

    Parameters
    ----------
    model : ModelFit
        A fit; finite rotations and terms are taken off its readings.
    """
    system = placed(model.problem)
    if system is None or system.grid.too_large_to_refine:
        return None
    refined = with_map(model, system.grid.views.spline.refined)
    if refined is None:
        return None
    coarse, fine = _of_marks(model), _of_marks(refined)
    dof = system.grid.equations_of_map - fine.determined_coefficients
    if dof < 1 and not system.grid.views.bilinear:
        return None
    finer = _against_finer(model, coarse, refined, fine)
    smoother = _against_smoother(model, coarse)
    power = finer.power
    if smoother.shown and smoother.power.mean() > power.mean():
        power = smoother.power
    shape = system.grid.views.shape
    local = np.zeros((2, *shape))
    i, j = _halves(coarse)
    nodes = (i % 2 == 0) & (j % 2 == 0)
    local[:, i[nodes] // 2, j[nodes] // 2] = np.sqrt(power.reshape(2, -1)[:, nodes])
    return Adequacy(
        p=min(finer.p, smoother.p),
        lack=float(np.sqrt(power.mean())),
        coefficients=fine.determined_coefficients - coarse.determined_coefficients,
        nodes=shape,
        local=local,
    )


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A map against another one of the same readings.

    Attributes
    ----------
    p : float
        Probability by chance that the other map explains the readings so much better.
    power : float array (2 P,)
        Squared error of the map at the known places, m^2.
    """

    p: float
    power: np.ndarray

    @property
    def shown(self) -> bool:
        """Whether the readings show that the map does not suffice."""
        return self.p < F_LEVEL


def _against_finer(
    model: ModelFit, coarse: PlacedEquations, refined: ModelFit, fine: PlacedEquations
) -> _Comparison:
    """Compare a map with one of twice as many intervals (method eq. 12.4).

    `coarse` and `fine` are the equations of the marks alone of `model` and `refined`.
    """
    nothing = np.zeros(2 * len(known_places(coarse)))
    dof = coarse.grid.equations_of_map - fine.determined_coefficients
    n_further = fine.determined_coefficients - coarse.determined_coefficients
    if dof < 1 or n_further < 1:
        return _Comparison(1.0, nothing)
    squares_fine = _squares(fine, refined.y)
    p = _improved(_squares(coarse, model.y), squares_fine, n_further, dof)
    if p == 1.0:
        return _Comparison(p, nothing)
    suffices = p >= F_LEVEL
    y = model.y if suffices else refined.y  # the terms of a map that suffices
    sigma_m = max(float(np.sqrt(squares_fine / dof)), FLOOR)
    power = _Further.of(fine, coarse, y).power(sigma_m)
    if not suffices:
        power = power + _of_terms(model, refined) ** 2
    return _Comparison(p, power)


def _against_smoother(model: ModelFit, coarse: PlacedEquations) -> _Comparison:
    """Compare a bilinear map with the bicubic one of the same nodes, by likelihood.

    `coarse` are the equations of the marks alone.
    """
    nothing = _Comparison(1.0, np.zeros(2 * len(known_places(coarse))))
    if not coarse.grid.views.bilinear:
        return nothing
    squares = _squares(coarse, model.y)
    if squares <= coarse.grid.equations_of_map * FLOOR**2:
        return nothing
    artifact = coarse.grid.views.artifact
    smooth = with_map(model, MapSpline.of(artifact.field, Interpolation.BICUBIC))
    if smooth is None:
        return nothing
    squares_smooth = max(_squares(_of_marks(smooth), smooth.y), FLOOR * squares)
    exponent = coarse.dof_of_map / 2 * math.log(squares_smooth / squares)
    return _Comparison(math.exp(min(exponent, 0.0)), _apart(smooth, model, coarse))


def _of_marks(model: ModelFit) -> PlacedEquations:
    """Return the equations of the marks alone."""
    system = cast(PlacedEquations, model.problem.system)
    return PlacedEquations(
        system.grid, AngularSystem((), np.zeros((0, 0))), system.grid_index, ()
    )


def _of_terms(model: ModelFit, of_other_map: ModelFit) -> float:
    """Return what the terms change of a map by what another map makes of them, rms, m."""
    map_change_m = model.equations.maps @ (
        of_other_map.coefficients - model.coefficients
    )
    return float(np.sqrt((np.abs(map_change_m) ** 2).mean() / 2))


def maps_to_try(measurements: Measurements) -> Iterator[tuple[str, Measurements]]:
    """Yield the readings with smoother or closer nodes over the same field, and their --map."""
    artifact = measurements.artifact
    grid = measurements.artifact.map_grid
    if grid is None or grid.size_y not in (0, grid.size):
        return
    first = grid.size + 2 * (grid.interpolation is Interpolation.BICUBIC)
    for size in range(first, min(artifact.shape), 2):
        text = f"{size}:{Interpolation.BICUBIC}"
        yield text, replace(measurements, artifact=with_nodes(artifact, text, "map"))


def _improved(
    squares_coarse: float, squares_fine: float, n_further: float, dof: float
) -> float:
    """Return the probability of such an improvement by chance (method eq. 12.4)."""
    if squares_fine < dof * FLOOR**2:  # there is no F of rounding
        return 1.0 if squares_coarse < 4 * (dof + n_further) * FLOOR**2 else 0.0
    return float(
        fdtrc(
            n_further,
            dof,
            max(squares_coarse - squares_fine, 0.0) / n_further / (squares_fine / dof),
        )
    )


def line_adequacy_of(model: ModelFit) -> Adequacy | None:
    """Return the test of the harmonics of the angular map by twice as many, if K allows more.

    None for a map that is no Fourier series, or if nothing more can be determined.
    """
    coarse, y = model.problem.system.angular, model.problem.angular.y
    if not isinstance(coarse, HarmonicSystem):
        return None
    finer = min(2 * coarse.harmonics, (coarse.n_lines - 1) // 2)
    fine = HarmonicSystem(coarse.turns, coarse.weight, finer)
    n_further = fine.n_determined - coarse.n_determined
    dof = fine.n_left
    if n_further < 1 or dof < 1:
        return None
    (squares_coarse, coarse_map), (squares_fine, fine_map) = (
        _fitted_lines(lines, y) for lines in (coarse, fine)
    )
    square = float(((fine_map - coarse_map) ** 2).mean()) - squares_fine / dof * (
        fine.mean_variance - coarse.mean_variance
    )
    return Adequacy(
        _improved(squares_coarse, squares_fine, n_further, dof),
        float(np.sqrt(max(square, 0.0))),
        n_further,
        (coarse.harmonics,),
    )


def _fitted_lines(lines: HarmonicSystem, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the squares of residuals of lines fitted alone, and their map without its mean."""
    field, phi = lines.fitted(y, np.linalg.pinv(lines.schur, rcond=GAP, hermitian=True))
    return lines.squares(lines.plate(y, field, phi)[1]), field - field.mean()


def known_places(system: PlacedEquations) -> np.ndarray:
    """Return the known nodes and the middles between known nodes, complex (P,), m."""
    s, t = _halves(system)
    views = system.grid.views
    x, y = s / 2 - views.half[0], t / 2 - views.half[1]
    return (x + 1j * y) * views.spline.pitch_m


def _halves(system: PlacedEquations) -> tuple[np.ndarray, np.ndarray]:
    """Return the same places in half pitches of the map from its first node, int (P,) each."""
    known_sites = system.known_sites
    s, t = np.indices([2 * size - 1 for size in system.grid.views.shape]).reshape(2, -1)
    low = (s // 2, t // 2)
    high = ((s + 1) // 2, (t + 1) // 2)
    inside = (
        known_sites[low]
        & known_sites[high]
        & known_sites[low[0], high[1]]
        & known_sites[high[0], low[1]]
    )
    return s[inside], t[inside]


def _squares(system: PlacedEquations, y: np.ndarray) -> float:
    return system.grid.squares(grid_residuals(system, y))


def _apart(smooth: ModelFit, model: ModelFit, coarse: PlacedEquations) -> np.ndarray:
    """Return the squared difference of two maps at the known places of one, (2 P,), m^2."""
    places_m = known_places(coarse)
    field = _datum_of(places_m).without(
        _map_of_marks(smooth, places_m) - _map_of_marks(model, places_m)
    )
    return np.concatenate([field.real, field.imag]) ** 2


def _map_of_marks(model: ModelFit, places_m: np.ndarray) -> np.ndarray:
    """Return the map of the marks alone at places, in no particular datum, complex (P,), m."""
    system = _of_marks(model)
    spline = system.grid.views.spline
    return (
        spline.rows(places_m) @ spline.coefficients(system.grid_fit(model.y)[0]).ravel()
    )


def _datum_of(places_m: np.ndarray) -> Gauge:
    """Return the datum of a map at places, complex (P,)."""
    return Gauge(
        places_m / abs(places_m).max(), np.ones(len(places_m), dtype=bool), scale=True
    )


def _between(rows: np.ndarray, matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return rows^T matrix columns, of real parts and imaginary ones, (2 p, 2 q)."""
    n = len(rows)
    blocks = rows.T @ matrix.reshape(2, n, 2, n).swapaxes(1, 2) @ columns
    return blocks.swapaxes(1, 2).reshape(2 * rows.shape[1], -1)


@dataclass(frozen=True, eq=False)
class _Further:
    """Information on the coefficients e by which a refined map differs from a coarse one.

    The refined map is the coarse one and Z e, Z e = 0 at the nodes; all else is eliminated.

    Attributes
    ----------
    information : float array (2 n,)
        Eigenvalues of the information on e, real and imaginary parts, for unit noise.
    right : float array (2 n,)
        Right-hand side along its eigenvectors, m.
    error : float array (2 P, 2 n)
        Error of the coarse map at places, datum taken out, for a unit along each eigenvector.
    """

    information: np.ndarray
    right: np.ndarray
    error: np.ndarray

    @classmethod
    def of(
        cls, fine: PlacedEquations, coarse: PlacedEquations, y: np.ndarray
    ) -> "_Further":
        """Return it for refined and coarse equations of the same readings y."""
        places_m = known_places(coarse)
        grid = fine.grid
        spline = grid.views.spline
        matrix, couple = grid.matrix, grid.coupling
        b, d = grid.right_side(y)
        within = np.linalg.pinv(grid.block, hermitian=True, rcond=GAP)
        coupling = np.concatenate([couple.real, couple.imag])
        elimination = coupling @ within
        normal = np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])
        normal -= elimination @ coupling.T
        right = np.stack([b.real, b.imag]) - (elimination @ d).reshape(2, -1)
        contained = coarse.grid.views.spline.within(spline)
        # what Z has at the nodes is of the coarse map, which is eliminated
        further = qr(contained)[0][:, contained.shape[1] :]
        inverse = np.linalg.pinv(
            _between(contained, normal, contained), hermitian=True, rcond=GAP
        )
        both = _between(contained, normal, further)
        answer = inverse @ both
        eigenvalues, vectors = np.linalg.eigh(
            _between(further, normal, further) - both.T @ answer
        )
        on_places = spline.rows(places_m)
        real, imaginary = np.hsplit(
            (on_places @ contained) @ np.hstack(np.split(answer @ vectors, 2))
            - (on_places @ further) @ np.hstack(np.split(vectors, 2)),
            2,
        )
        field = _datum_of(places_m).without(real + 1j * imaginary)
        of_further = (right @ further).ravel() - answer.T @ (right @ contained).ravel()
        return cls(
            np.maximum(eigenvalues, 0.0),
            vectors.T @ of_further,
            np.concatenate([field.real, field.imag]),
        )

    def size(self, sigma_m: float) -> float:
        """Return the likeliest standard deviation of the coefficients, m (method eq. 12.5)."""
        determined = self.information > GAP * self.information.max()
        values, right = self.information[determined], self.right[determined]
        least = sigma_m / np.sqrt(values.max())
        sizes = np.concatenate([[0.0], least * np.geomspace(*SIZES)])
        variance = values * sigma_m**2 + np.multiply.outer(sizes, values) ** 2
        return float(
            sizes[(np.log(variance) + right**2 / variance).sum(axis=1).argmin()]
        )

    def power(self, sigma_m: float) -> np.ndarray:
        """Return the mean squared error of the coarse map at the places (eq. 12.6), (2 P,), m^2."""
        size = self.size(sigma_m)
        if not size:
            return np.zeros(len(self.error))
        share = size**2 / (sigma_m**2 + size**2 * self.information)
        return (self.error @ (share * self.right)) ** 2 + self.error**2 @ (
            share * sigma_m**2
        )
