# SPDX-License-Identifier: Apache-2.0
"""Noise that the marks of an image share, in addition to that of each mark (method eq. 4.15).

Vibration and noise of the encoders move all marks of an image together. Such noise looks like an
error of the stage, so that residuals show only part of it. Both noises follow from two sums of
squares of the residuals, of the readings and of the images' sums, and from what draws of either
noise make of them, with the terms that only images show fitted to them as to the readings.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.estimation.normal.equations import N_DRAWS, NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.view import CellsSeen, View, cells_seen


@dataclass(frozen=True)
class TwoNoises:
    """Noises of one reading: common to the marks of an image, and of a mark, m.

    `dof` are the degrees of freedom of what both make of the map, `dof_mark` those of `mark`.
    """

    image: float
    mark: float
    dof: float
    dof_mark: float

    @property
    def sigma(self) -> float:
        """Standard deviation of one reading, m."""
        return math.hypot(self.image, self.mark)

    @property
    def share(self) -> float:
        """Correlation of the marks of an image."""
        return self.image**2 / self.sigma**2 if self.sigma else 0.0

    def excess(self, marks: float) -> float:
        """Return the variance of what images of so many marks have in common, over a reading's."""
        return 1 + (marks - 1) * self.share


@dataclass(frozen=True, eq=False)
class FittedTerms:
    """Terms fitted to the residuals of grid readings.

    Attributes
    ----------
    weight : float array (views, nx, ny)
        Weights of the readings.
    residuals : complex array (p, views, nx, ny)
        What the maps leave of the readings for a unit of each coefficient.
    parameters : float array (p, 3 views)
        The misalignments that they take up.
    inverse : float array (p, p)
        Pseudo-inverse of their information: covariance of the coefficients for unit noise.
    rank : int
        Number of combinations that the readings determine.
    """

    weight: np.ndarray
    residuals: np.ndarray
    parameters: np.ndarray
    inverse: np.ndarray
    rank: int

    def freed(
        self, residual: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals and misalignments of a fit without the terms after one with them."""
        right = np.einsum(
            "pvij,vij->p", self.residuals.conj(), self.weight * residual
        ).real
        values = self.inverse @ right
        return (
            residual - np.tensordot(values, self.residuals, 1),
            parameters - values @ self.parameters,
        )


@dataclass(frozen=True, eq=False)
class Images:
    """Images behind the grid readings.

    Attributes
    ----------
    stop : int array (n,)
        Index of the stop of the stage at which each reading was made, of those read: the images
        taken there.
    read : bool array (views, nx, ny)
        The readings.
    weight : float array (n,)
        Their weights.
    """

    stop: np.ndarray
    read: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, grid: GridSystem, views: CellsSeen) -> "Images":
        """Return the images of readings; `views` as `stops_of` takes them."""
        return cls(stops_of(views, grid.read), grid.read, grid.weight[grid.read])

    @property
    def marks(self) -> float:
        """Number of marks of an image, as a mean over its marks."""
        return marks_of_image(self.stop)

    def sums(self, residual: np.ndarray) -> np.ndarray:
        """Return the sum of squares of residuals (views, nx, ny), and that of images' sums, m^2."""
        weighted = np.sqrt(self.weight) * residual[self.read]
        of_images = np.bincount(self.stop, weighted.real) + 1j * np.bincount(
            self.stop, weighted.imag
        )
        return np.array([(abs(weighted) ** 2).sum(), (abs(of_images) ** 2).sum()])

    def of_marks(self, sensitivities: np.ndarray) -> np.ndarray:
        """Return the variances, (k,), for unit noise of each mark by itself."""
        return (abs(self._by_marks_and_images(sensitivities)[0]) ** 2).sum(axis=1)

    def added(self, sensitivities: np.ndarray) -> np.ndarray:
        """Return what full correlation within images adds to variances, (k,), for unit noise.

        Parameters
        ----------
        sensitivities : complex array (k, views, nx, ny)
            Sensitivities of k coordinates over the weights, see `added_variances`.
        """
        of_marks, of_images = self._by_marks_and_images(sensitivities)
        return (abs(of_images) ** 2).sum(axis=1) - (abs(of_marks) ** 2).sum(axis=1)

    def added_covariance(self, sensitivities: np.ndarray) -> np.ndarray:
        """Return the same of all pairs of coordinates, (k, k)."""
        of_marks, of_images = self._by_marks_and_images(sensitivities)
        return (of_images @ of_images.conj().T - of_marks @ of_marks.conj().T).real

    def _by_marks_and_images(
        self, sensitivities: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return sensitivities to readings of unit noise, (k, n), and to images, (k, stops)."""
        of_marks = np.sqrt(self.weight) * sensitivities[:, self.read]
        of_images = np.zeros(
            (len(sensitivities), int(self.stop.max()) + 1), dtype=complex
        )
        np.add.at(of_images.T, self.stop, of_marks.T)
        return of_marks, of_images


@dataclass(frozen=True, eq=False)
class ImageNoise(Images):
    """Images behind the grid readings, and what noise leaves in their residuals.

    Attributes
    ----------
    drawn : float array (draws, 2, 3)
        Sums of squares of the residuals, and of the sums of images, for unit noise of marks, for
        that of images, and of both together less these.
    parameters : float array (draws, 2, 3 views)
        Misalignments for unit noise of marks and of images, as in `JointFit`, m.
    dof_of_terms : int
        Degrees of freedom that the terms of the draws take.
    gain : float
        Variance of the map (mean over its nodes) for unit noise of images, over that for unit noise
        of marks.
    """

    drawn: np.ndarray
    parameters: np.ndarray
    dof_of_terms: int
    gain: float

    def noises(self, residual: np.ndarray) -> TwoNoises:
        """Return the noises that residuals (views, nx, ny) show."""
        expected = self.drawn.mean(axis=0)
        sums = self.sums(residual)
        from_sums = np.linalg.inv(expected[:, :2])
        variances = from_sums @ sums
        if variances.min() < 0:  # one of the two alone
            larger = int(variances[1] > variances[0])
            from_sums = np.zeros((2, 2))
            from_sums[larger, 0] = 1 / expected[0, larger]
            variances = from_sums @ sums
        mark, image = np.sqrt(variances)
        drawn = self.drawn @ [mark**2, image**2, mark * image]
        return TwoNoises(
            float(image),
            float(mark),
            _dof_of(drawn @ ([1, self.gain] @ from_sums)),
            _dof_of(drawn @ from_sums[0]),
        )


def marks_of_image(stop: np.ndarray) -> float:
    """Return the number of marks of an image, as a mean over the marks with these stops, (n,)."""
    count = np.bincount(stop)
    return float((count**2).sum() / count.sum())


def _dof_of(draws: np.ndarray) -> float:
    """Return the degrees of freedom of a variance from draws of its estimate."""
    spread = draws.var(ddof=1)
    return float(2 * draws.mean() ** 2 / spread) if spread else math.inf


def image_noise(
    artifact: Artifact,
    views: Sequence[View],
    system: NormalEquations,
    *,
    inputs: TermInputs,
    terms: Sequence[ModelTerm],
) -> ImageNoise | None:
    """Return the images behind grid readings; None without images.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    views : sequence of View
        All views of the measurement; sub-views of one view have images in common.
    system : NormalEquations
        The grid readings.
    inputs : TermInputs
        What is made of the readings.
    terms : sequence of ModelTerm
        Terms of the model that only images show.
    """
    cells = cells_seen(artifact, [views[index] for index in system.grid_index])
    if cells is None:
        return None
    drawn = _drawn_before.setdefault(system, {})
    key = cells, tuple(term.name for term in terms)
    if key not in drawn:
        nominal = replace(inputs, visits=(None,) * len(inputs.names))
        drawn[key] = _drawn(system, cells, term_columns(nominal, terms).grid)
    return drawn[key]


_drawn_before: WeakKeyDictionary[NormalEquations, dict[tuple, ImageNoise]] = (
    WeakKeyDictionary()
)
"""Images of systems, by their cells and terms; they must not refer to the system."""


def _fitted_terms(system: NormalEquations, columns: np.ndarray) -> FittedTerms:
    """Return what is left of columns (p, views, nx, ny)."""
    grid = system.grid
    residuals = np.zeros(columns.shape, dtype=complex)
    parameters = np.zeros((len(columns), 3 * grid.n_views))
    for number, column in enumerate(columns):
        residuals[number], parameters[number], _ = fitted_alone(
            system, column[grid.read]
        )
    flat = residuals[:, grid.read]
    gram = (flat.conj() @ (grid.weight[grid.read] * flat).T).real
    norm = np.abs(flat).max(initial=0.0)
    values, vectors = np.linalg.eigh(gram)
    determined = values > GAP * norm**2 * len(flat.T)
    inverse = (vectors[:, determined] / values[determined]) @ vectors[:, determined].T
    return FittedTerms(
        grid.weight, residuals, parameters, inverse, int(determined.sum())
    )


def _drawn(
    system: NormalEquations, views: CellsSeen, columns: np.ndarray
) -> ImageNoise:
    """Return images and draws of readings, with columns (p, views, nx, ny) fitted to them.

    `views` are the names in the plan and steps of cells.
    """
    grid = system.grid
    images = Images.of(grid, views)
    fitted = _fitted_terms(system, columns)
    drawn = np.zeros((N_DRAWS, 2, 3))
    parameters = np.zeros((N_DRAWS, 2, 3 * len(views)))
    power = np.zeros(2)
    rng = np.random.default_rng(0)
    for row, of_draw in zip(drawn, parameters, strict=True):
        mark, image = (
            rng.normal(size=(size, 2)) @ [1, 1j]
            for size in (len(images.stop), images.stop.max() + 1)
        )
        solved = [
            fitted_alone(system, values / np.sqrt(images.weight))
            for values in (mark, image[images.stop])
        ]
        power += [of_noise[2] for of_noise in solved]
        residuals, of_draw[:] = zip(
            *(fitted.freed(*of_noise[:2]) for of_noise in solved), strict=True
        )
        row[:, :2] = np.stack([images.sums(of_noise) for of_noise in residuals], axis=1)
        row[:, 2] = images.sums(residuals[0] + residuals[1]) - row[:, 0] - row[:, 1]
    return ImageNoise(
        **vars(images),
        drawn=drawn,
        parameters=parameters,
        dof_of_terms=fitted.rank,
        gain=float(power[1] / power[0]),
    )


def stops_of(views: CellsSeen, read: np.ndarray) -> np.ndarray:
    """Return the index of the stop of each reading, int array (n,).

    A stop is that of a view of the plan, at the mark from which the cell is as many steps away.
    """
    names = list(dict.fromkeys(name for name, _ in views))
    view, m, n = np.nonzero(read)
    steps = np.array([step for _, step in views])
    keys = np.stack(
        [
            np.array([names.index(name) for name, _ in views])[view],
            m - steps[view, 0],
            n - steps[view, 1],
        ]
    )
    return np.unique(keys, axis=1, return_inverse=True)[1].reshape(-1)


def fitted_alone(
    system: NormalEquations, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return residuals (views, nx, ny), misalignments and square of the map of readings (n,).

    Of the grid alone, in the datum.
    """
    grid = system.grid
    y = np.zeros(grid.read.shape, dtype=complex)
    y[grid.read] = values
    field, parameters, _, residual = system.in_datum(y, *system.grid_fit(y))
    map_values = np.where(system.known_sites, field, 0)
    return residual, parameters, float((abs(map_values) ** 2).sum())
