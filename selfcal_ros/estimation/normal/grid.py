# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the grid readings with the plate eliminated (method eqs. 4.3-4.5).

They couple the stage error G at the sites that one mark visits, and three numbers per view (phi,
Re tau, Im tau), which are eliminated last.
"""

from functools import cached_property

import numpy as np
from scipy.linalg import helmert

from selfcal_ros.estimation.lattice.connectivity import free_turns
from selfcal_ros.estimation.lattice.maps import PHASES, LatticeViews, rigid_parameters
from selfcal_ros.estimation.multifrontal.factor import Factor, fold
from selfcal_ros.estimation.normal.eliminated import PlateEliminated
from selfcal_ros.model.pose import LatticePose


class GridSystem(PlateEliminated):
    """Normal equations of a set of grid readings, independent of their values.

    Parameters
    ----------
    poses : tuple of LatticePose
        One per view.
    weight : float array (views, nx, ny)
        Weight of each reading; 0 = not read.
    rotations : tuple of int
        The first of the views that have the rotation of each view, see `rotations_of`. Empty: each
        view has its own.
    known_plate : bool
        Whether the plate is known, so that no mark is eliminated.
    """

    coordinates, of_view = 2, 3

    def __init__(
        self,
        poses: tuple[LatticePose, ...],
        weight: np.ndarray,
        rotations: tuple[int, ...] = (),
        *,
        known_plate: bool = False,
    ) -> None:
        super().__init__(weight, known_plate=known_plate)
        self.rotations = rotations
        self.views = LatticeViews(weight.shape[1:], poses)

    @property
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Site, mark and quarter turns of every reading."""
        view, mark = np.nonzero(self.read.reshape(self.n_views, -1))
        site = self.views.site_index.reshape(self.n_views, -1)[view, mark]
        return site, mark, np.array([pose.q for pose in self.views.poses])[view]

    @cached_property
    def free_turns(self) -> tuple[np.ndarray, np.ndarray]:
        """Quarter turns of the free vectors of components at sites and marks, int (sites,) each."""
        return free_turns(*self.edges, self.components)

    @cached_property
    def factor(self) -> Factor:
        """Factorisation of the matrix over the sites, with pins for free components."""
        folded = fold(self.views, self.weight, self.relative_weight, self.pins)
        return Factor(*folded, self.views.shape, self.views.reach)

    @property
    def variance_of_sites(self) -> np.ndarray:
        """Variance of the stage error at each site, (sites,): known misalignments, unit noise."""
        return self.factor.variances[0]

    @property
    def variance_of_means(self) -> np.ndarray:
        """Variance of the mean stage error at the sites of each mark, (marks,), likewise."""
        return self.factor.variances[1]

    @cached_property
    def shapes(self) -> np.ndarray:
        """Effect of phi and Re tau of a view on its readings: i z and 1, complex (2, nx, ny)."""
        return np.stack([1j * self.views.z, np.ones(self.views.plate_shape)])

    @cached_property
    def differences(self) -> np.ndarray:
        """Differences between rotations that are one, orthonormal (3 views, k)."""
        differences = []
        for first in dict.fromkeys(self.rotations):
            views = np.flatnonzero(np.array(self.rotations) == first)
            between_views = np.zeros((3 * self.n_views, len(views) - 1))
            between_views[3 * views] = helmert(len(views)).T
            differences.append(between_views)
        return np.hstack([np.zeros((3 * self.n_views, 0)), *differences])

    @property
    def n_misalignments(self) -> int:
        """Number of misalignments: a rotation that views share counts once."""
        return 3 * self.n_views - self.differences.shape[1]

    def tied(self, normal: np.ndarray) -> np.ndarray:
        """Return a normal matrix of misalignments with `differences` without information."""
        differences = self.differences
        if differences.shape[1]:
            n = len(differences)
            normal = normal.copy()
            normal[:n] -= differences @ (differences.T @ normal[:n])
            normal[:, :n] -= (normal[:, :n] @ differences) @ differences.T
        return normal

    @cached_property
    def rigid(self) -> np.ndarray:
        """The datum modes in terms of the misalignments, (7, 3 views)."""
        return rigid_parameters(self.views).reshape(7, -1)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return M^-1 of right-hand sides, complex (sites,) or (sites, k)."""
        return self.factor.solve(np.ascontiguousarray(right))

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return maps, complex (sites,) or (..., nx, ny), at the marks, (..., views, nx, ny)."""
        return self.views.gather(
            field.reshape(self.views.shape) if field.ndim == 1 else field
        )

    def covariance(self, matrix: np.ndarray, first: int, second: int) -> np.ndarray:
        """Return the covariances of the map at marks of one and another view, (nx, ny)."""
        site = np.maximum(self.views.site_index, 0)
        phase = self.views.phases
        return phase[first].conj() * matrix[site[first], site[second]] * phase[second]

    def adjoint(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums of readings (k, views, nx, ny) at sites, (sites, k), and over misalignments.

        The latter as phi, Re tau, Im tau of each view, (3 views, k).
        """
        sums = np.tensordot(self.shapes.conj(), readings, axes=([1, 2], [2, 3]))
        return (
            self.views.scatter(readings).reshape(len(readings), -1).T,
            of_misalignments(sums.transpose(2, 0, 1).reshape(2 * self.n_views, -1)),
        )

    def misaligned(self, parameters: np.ndarray) -> np.ndarray:
        """Return phi i z + tau at every mark, complex (..., views, nx, ny), from (..., 3 views)."""
        of_views = parameters.reshape(*parameters.shape[:-1], self.n_views, 3)
        phi = of_views[..., 0]
        tau = of_views[..., 1] + 1j * of_views[..., 2]
        return phi[..., None, None] * self.shapes[0] + tau[..., None, None]

    def free_parts_small(
        self, field: np.ndarray, plate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return G and A with zero mean plate error in each free component.

        The linear model does not determine the vector of such a component; a finite rotation
        turns it, so that 0.4 mm (as left by the pins) gave residuals of 2 um at 0.3°.

        Parameters
        ----------
        field, plate : complex array (nx, ny)
            G and A in their datum, m.
        """
        components = self.components
        if not components.balanced.any():
            return field, plate
        at_site, at_mark = self.free_turns
        n = len(components.balanced)
        sites = np.flatnonzero(
            (components.of_site >= 0) & components.balanced[components.of_site]
        )
        marks = np.flatnonzero(
            (components.of_mark >= 0) & components.balanced[components.of_mark]
        )
        component = components.of_mark[marks]
        unit = PHASES[at_mark[marks]]
        back = unit.conj() * plate.ravel()[marks]
        mean = np.bincount(component, back.real, n) + 1j * np.bincount(
            component, back.imag, n
        )
        mean /= np.maximum(np.bincount(component, minlength=n), 1)
        field, plate = field.copy(), plate.copy()
        field.ravel()[sites] += PHASES[at_site[sites]] * mean[components.of_site[sites]]
        plate.ravel()[marks] -= unit * mean[component]
        return field, plate


def of_misalignments(sums: np.ndarray) -> np.ndarray:
    """Return sums over phi and tau of each view (2 views, ...) as phi, Re tau, Im tau."""
    phi, tau = sums[::2], sums[1::2]
    of_views = np.stack([phi.real, tau.real, tau.imag], axis=1)
    return of_views.reshape(3 * len(phi), *sums.shape[1:])
