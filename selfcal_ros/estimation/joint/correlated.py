# SPDX-License-Identifier: Apache-2.0
"""Noise that is correlated in time, and what it makes of the map's uncertainty (method eq. 4.12).

White noise has the same power at all periods; a slow one has more of it at those of a line or a
pass, which repeats soon after each other do not show.
"""

import numpy as np
from scipy.special import chdtrc

from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.joint.axes import added_variances
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.noise import F_LEVEL, SAME
from selfcal_ros.estimation.joint.problem import FLOOR
from selfcal_ros.estimation.terms.visits import ViewVisits

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
    if lags < TESTED or not model.found.xy.sigma > FLOOR:
        return np.zeros(0)
    products, number = np.zeros(lags + 1), 0
    for _, _, order, rest in views:
        one = rest[order]
        products += [float(np.vdot(one[:len(one) - k], one[k:]).real) for k in range(lags + 1)]
        number += len(one)
    found = products[1:] / products[0]
    p = float(chdtrc(TESTED, 2 * number * float((found[:TESTED] ** 2).sum())))
    found = found * (1 - np.arange(1, lags + 1) / (lags + 1))
    return found if p < F_LEVEL and 1 + 2 * found.sum() > SAME**2 else np.zeros(0)


def correlated_variances(model: ModelFit, cover: FieldCovariance,
                         correlation: np.ndarray) -> np.ndarray:
    """Return what correlated noise adds to the variances, (2, nx, ny), for unit noise."""
    views = _by_time(model)

    def of(rest: np.ndarray) -> np.ndarray:
        total = np.zeros(len(rest))
        for row, visits, order, _ in views:
            one = (np.sqrt(visits.weight) * rest[:, row].reshape(len(rest), -1)[:, visits.mark]
                   )[:, order]
            power = abs(np.fft.fft(one, 2 * one.shape[1])) ** 2
            products = np.fft.ifft(power).real[:, 1:len(correlation) + 1]
            total += 2 * products @ correlation
        return total

    return added_variances(model, cover, of)


def _by_time(model: ModelFit) -> list[tuple[int, ViewVisits, np.ndarray, np.ndarray]]:
    """Return row, visits, their order and weighted residuals of views with repeated visits."""
    known = [] if model.equations is None else model.equations.columns.at_visits(
        model.coefficients)
    found = []
    for row, visits in enumerate(model.problem.ground.visits):
        if visits is None or not visits.repeated:
            continue
        y, residual = visits.y - (known[row] if known else 0.0), model.found.residuals[row]
        rest = visits.about_means(y[None], residual.size)[0] + residual.reshape(-1)[visits.mark]
        found.append((row, visits, np.argsort(visits.time, kind="stable"),
                      np.sqrt(visits.weight) * rest))
    return found
