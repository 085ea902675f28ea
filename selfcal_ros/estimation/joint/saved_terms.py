# SPDX-License-Identifier: Apache-2.0
"""Contribution of the model's terms to a map's covariance, as stored in RESULT.json.

With L (r, 2, nx, ny), cov(G) = sigma^2 (S + sum_r L_r L_r'), where S follows from the weights of
the readings, so a saved map can be compared as exactly as the calibration itself. Each factor
belongs to a term with a size, and is the variance that the map would lose if that term were known,
or to the free terms together.
"""

from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.datum.covariance import FieldCovariance
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import CalibrationResult

KEY = "covariance_terms"
"""Key of the factors in a result."""

MAX_SITES = 31 * 31
"""Largest field for a full covariance matrix."""

NEGLIGIBLE = 1e-3
"""Length of a factor, in units of the noise, that changes no uncertainty by a thousandth."""

ROUNDING = 1e-12
"""Relative size below which a variance is zero."""

FREE = ""
"""Name of the factors of all free terms."""

ANGULAR_KEY = "angular_terms"
"""Key of each term's contribution to the standard uncertainty of the angular map, rad."""

DIGITS = 7
"""Digits of a factor stored."""

LEAST = 1e-12
"""Entries of a factor below this are dropped, in units of the noise."""


def saved_terms(cover: FieldCovariance, columns: TermColumns, sense: Sense) -> dict[str, Any]:
    """Return the factors for `CalibrationResult.extra`; empty without terms, or for large fields.

    Parameters
    ----------
    cover : FieldCovariance
        Of the map, in the frame of the equations, terms included.
    columns : TermColumns
        The terms.
    sense : Sense
        What moved: the factors are in the stage frame.
    """
    shape = cover.system.grid.views.shape
    if cover.system.grid.n_sites > MAX_SITES:
        return {}
    maps = cover.maps_of_terms().reshape(*shape, -1)
    maps = np.where(cover.system.known_sites[..., None], maps, 0.0)
    if sense is Sense.PLATE_MOVES:
        maps = maps[::-1, ::-1]
    both = np.concatenate([maps.real.reshape(-1, maps.shape[2]),
                           maps.imag.reshape(-1, maps.shape[2])])
    factors, names = [], []
    for name, root in _roots(cover.terms.covariance, columns):
        left, size, _ = np.linalg.svd(both @ root, full_matrices=False)
        kept = size > NEGLIGIBLE
        factors += list((left[:, kept] * size[kept]).T.reshape(-1, 2, *shape))
        names += [name] * int(kept.sum())
    return {KEY: {"terms": names, "factors": rounded(np.array(factors)).tolist()}}


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values rounded to `DIGITS` digits, none smaller than `LEAST`.

    As quotients of an exact power of ten, so that they print with no more digits.
    """
    size = np.abs(values)
    digits = DIGITS - 1 - np.floor(np.log10(np.maximum(size, LEAST)))
    power = 10.0 ** np.maximum(digits, 0.0)
    return np.where(size < LEAST, 0.0, np.round(values * power) / power)


def _roots(covariance: np.ndarray, columns: TermColumns) -> list[tuple[str, np.ndarray]]:
    """Return roots (p, k) of parts of a covariance: of each term with a size, of the free ones.

    A part is the reduction of the covariance if that term, and those before it, are
    known: the parts add up to the covariance.
    """
    rest, out = covariance.copy(), []
    sized = dict.fromkeys(c.term for c in columns.columns if np.isfinite(c.size))
    for name in sized:
        at = columns.rows([name])
        values, vectors = np.linalg.eigh(rest[np.ix_(at, at)])
        told = values > ROUNDING * max(values[-1], 0.0)
        root = rest[:, at] @ (vectors[:, told] / np.sqrt(values[told]))
        rest = rest - root @ root.T
        out.append((str(name), root))
    own = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(rest / np.outer(own, own))
    out.append((FREE, own[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))))
    return out


def factors_of(result: CalibrationResult) -> np.ndarray:
    """Return the factors L of a result, (r, 2, nx, ny), for unit noise; r = 0 without terms.

    Raises
    ------
    InputError
        If they do not match the result's lattice.
    """
    shape = (2, *result.artifact.shape)
    if KEY not in result.extra:
        return np.zeros((0, *shape))
    try:
        kept = result.extra[KEY]
        factors = np.array(kept["factors"], dtype=float).reshape(-1, *shape)
        good = np.isfinite(factors).all() and len(factors) == len(kept["terms"])
    except (TypeError, ValueError, KeyError):
        good = False
    if not good:
        raise InputError(KEY, "no factors of this lattice",
                         "write the result again with `selfcal solve`")
    return factors


def angular_terms(cover: FieldCovariance, columns: TermColumns, sigma_m: float,
                  known: np.ndarray) -> dict[str, Any]:
    """Return the contribution of each term of the lines to the angular map, for `extra`: rad, (K,).

    Parameters
    ----------
    cover, columns : FieldCovariance, TermColumns
        As in `saved_terms`.
    sigma_m : float
        Noise of one grid reading, m.
    known : bool array (K,)
        Lines of the map; their mean is the datum.
    """
    out = {}
    for name in dict.fromkeys(columns.columns[at].term for at in columns.lines.at):
        rows = columns.rows([name])
        moved = cover.terms.turned[:, rows]
        moved = moved - moved[known].mean(axis=0)
        power = np.einsum("kp,pq,kq->k", moved, cover.terms.covariance[np.ix_(rows, rows)], moved)
        out[str(name)] = rounded(np.sqrt(np.maximum(power, 0.0)) * sigma_m)
    return {ANGULAR_KEY: out} if out else {}


def variance_of_terms(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the variance of the map from each term with a size, (2, nx, ny), m^2."""
    factors = factors_of(result)
    names = np.array(result.extra[KEY]["terms"] if len(factors) else [], dtype=str)
    return {str(name): (factors[names == name] ** 2).sum(axis=0) * result.noise.sigma_xy**2
            for name in dict.fromkeys(names.tolist()) if name != FREE}
