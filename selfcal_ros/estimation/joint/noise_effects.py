# SPDX-License-Identifier: Apache-2.0
"""Effect on the uncertainty of noise that differs between the axes or is correlated in time.

The estimate weights both coordinates alike. If their noises differ it remains unbiased, and the
variance of each node follows from the sensitivities of the map to the readings (method eq. 4.11).

White noise has the same power at all periods; correlated noise has more of it at the period of a
line or a pass, which repeats taken in quick succession do not show (method eq. 4.12).
"""

from collections.abc import Callable

import numpy as np
from scipy.special import chdtrc, fdtrc

from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.problem import (
    F_LEVEL,
    SAME,
    noise_excess,
)
from selfcal_ros.estimation.joint.slow_motion import slow_motion
from selfcal_ros.estimation.normal.angular import FLOOR
from selfcal_ros.estimation.normal.equations import BLOCK, ENOUGH_DOF
from selfcal_ros.estimation.terms.visits import ViewVisits


def axis_contrast(model: ModelFit) -> float:
    """Return (sx^2 - sy^2) / (sx^2 + sy^2) of the noises along the stage axes.

    By the repeats, or by the residuals if there are few. 0 unless the noises differ (F-test).
    """
    problem = model.problem
    squares = np.zeros(2)
    dof = 0.0
    for _, visits, residuals in model.visits_about_means():
        if visits.repeated:
            residuals = residuals / visits.phase
            squares += (
                visits.weight @ np.stack([residuals.real, residuals.imag], axis=1) ** 2
            )
            dof += visits.n_repeats
    if 2 * dof < ENOUGH_DOF:
        residuals = model.fitted.residuals * model.problem.to_stage[:, None, None]
        weight = problem.system.grid.weight
        squares = np.array(
            [
                (weight * coordinate**2).sum()
                for coordinate in (residuals.real, residuals.imag)
            ]
        )
        dof = model.fitted.xy.dof_residuals / 2
    dof /= noise_excess(problem, model.fitted.residuals)
    small, large = sorted(squares)
    if not (
        dof >= 1
        and small > 0
        and large > SAME**2 * small
        and 2 * float(fdtrc(dof, dof, large / small)) < F_LEVEL
    ):
        return 0.0
    return float((squares[0] - squares[1]) / squares.sum())


def structured(
    model: ModelFit, cover: MapsCovariance, rows: np.ndarray | None = None
) -> np.ndarray | float:
    """Return what noise that is neither equal along x and y nor white adds to the variances.

    Those of the nodes, or of functionals `rows` of the map, as `added_variances`.
    """
    added: np.ndarray | float = 0.0
    if contrast := axis_contrast(model):  # of noise along x in place of y, of unit size
        turn = model.problem.to_stage[:, None, None] ** 2
        weight = model.problem.system.grid.weight

        def along_x(sensitivities: np.ndarray) -> np.ndarray:
            return np.einsum("vij,kvij->k", weight, (turn * sensitivities**2).real)

        added = contrast * added_variances(cover, along_x, rows)
    if slow_motion(model) is None and len(correlation := time_correlation(model)):
        correlated = correlated_variances(model, cover, correlation, rows)
        # a share of either axis' noise, not of their mean; on the quieter axis at least that
        of_axis = correlated * added / _variances(cover, rows)
        added = (
            added
            + correlated
            + np.where(correlated < 0, of_axis, np.maximum(of_axis, 0.0))
        )
    return added + image_variances(model, cover, rows)


def _variances(
    cover: MapsCovariance, rows: np.ndarray | None, *, plate: bool = False
) -> np.ndarray:
    """Return the variances of white noise, for unit noise; parameters as `added_variances`."""
    if rows is not None:
        return np.diag(cover.of(rows))
    return cover.of_plate if plate else cover.of_stage


def image_variances(
    model: ModelFit,
    cover: MapsCovariance,
    rows: np.ndarray | None = None,
    *,
    plate: bool = False,
) -> np.ndarray | float:
    """Return what the noise that marks of an image share adds to the variances for unit noise.

    More if it is slow. Those of the stage's map, of functionals `rows` of it, or of the plate's.

    Where noise of the offsets is all that shows a microscope, its columns exaggerate the
    sensitivities: then noise of a mark must not make more than the variance itself.
    """
    images = model.problem.images
    if images is None or not (share := images.noises(model.fitted.residuals).share):
        return 0.0
    added = added_variances(cover, images.added, rows, plate=plate)
    variance = _variances(cover, rows, plate=plate)
    if (added < -variance).any():
        of_marks = added_variances(cover, images.of_marks, rows, plate=plate)
        added = added * np.minimum(
            1.0, variance / np.where(of_marks > 0, of_marks, 1.0)
        )
    added = share * added
    if motion := slow_motion(model):
        added = added + added_variances(cover, motion.added, rows, plate=plate)
    return added


def added_variances(
    cover: MapsCovariance,
    of: Callable[[np.ndarray], np.ndarray],
    rows: np.ndarray | None = None,
    *,
    plate: bool = False,
) -> np.ndarray:
    """Return `of` the sensitivities of each coordinate of a map, (2, nx, ny), or of functionals.

    Parameters
    ----------
    cover : MapsCovariance
        The covariance of the maps.
    of : callable
        Sensitivities of k coordinates to the readings, over their weights, plate frame, complex
        (k, views, nx, ny) -> k variances for unit noise.
    rows : complex array (k, nx, ny), optional
        Functionals of the stage's map, in place of its coordinates.
    plate : bool
        Take the coordinates of the plate's map.
    """
    if rows is not None:
        return of(cover.sensitivities(rows))
    views = cover.system.grid.views
    shape, other_shape = (
        (views.plate_shape, views.shape) if plate else (views.shape, views.plate_shape)
    )
    n = shape[0] * shape[1]
    variances = []
    for start in range(0, n, BLOCK):
        unit = np.eye(min(BLOCK, n - start), n, start).reshape(-1, *shape)
        nothing = np.zeros((len(unit), *other_shape))
        variances.append(
            [
                of(
                    cover.sensitivities(
                        *((nothing, unit * axis) if plate else (unit * axis, nothing))
                    )
                )
                for axis in (1, 1j)
            ]
        )
    return np.concatenate(variances, axis=1).reshape(2, *shape)


TESTED = 5
"""Lags, in visits, by which noise is tested for correlation."""

PART = 0.25
"""Longest lag, as a part of the visits of a view: over longer ones the fit takes up slow noise."""


def time_correlation(model: ModelFit) -> np.ndarray:
    """Return the correlation of the noise of visits by their distance in the order, from 1.

    Tapered (Bartlett), so that no period has negative power; empty if the noise is white (sum of
    squares of the first correlations against chi^2).
    """
    views = _by_time(model)
    lags = int(PART * min((len(order) for _, _, order, _ in views), default=0))
    if lags < TESTED or not model.fitted.xy.sigma > FLOOR:
        return np.zeros(0)
    products = np.zeros(lags + 1)
    number = 0
    for _, _, order, residuals in views:
        in_order = residuals[order]
        products += [
            float(np.vdot(in_order[: len(in_order) - k], in_order[k:]).real)
            for k in range(lags + 1)
        ]
        number += len(in_order)
    correlation = products[1:] / products[0]
    p = float(chdtrc(TESTED, 2 * number * float((correlation[:TESTED] ** 2).sum())))
    correlation = correlation * (1 - np.arange(1, lags + 1) / (lags + 1))
    return (
        correlation
        if p < F_LEVEL and 1 + 2 * correlation.sum() > SAME**2
        else np.zeros(0)
    )


def correlated_variances(
    model: ModelFit,
    cover: MapsCovariance,
    correlation: np.ndarray,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """Return what correlated noise adds to the variances, as `added_variances`."""
    views = _by_time(model)

    def of(sensitivities: np.ndarray) -> np.ndarray:
        total = np.zeros(len(sensitivities))
        for row, visits, order, _ in views:
            in_order = (
                np.sqrt(visits.weight)
                * sensitivities[:, row].reshape(len(sensitivities), -1)[:, visits.mark]
            )[:, order]
            power = abs(np.fft.fft(in_order, 2 * in_order.shape[1])) ** 2
            products = np.fft.ifft(power).real[:, 1 : len(correlation) + 1]
            total += 2 * products @ correlation
        return total

    return added_variances(cover, of, rows)


def _by_time(model: ModelFit) -> list[tuple[int, ViewVisits, np.ndarray, np.ndarray]]:
    """Return row, visits, their order and weighted residuals of views with repeated visits."""
    return [
        (
            row,
            visits,
            np.argsort(visits.time, kind="stable"),
            np.sqrt(visits.weight)
            * (residuals + model.fitted.residuals[row].reshape(-1)[visits.mark]),
        )
        for row, visits, residuals in model.visits_about_means()
        if visits.repeated
    ]
