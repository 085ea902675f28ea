# SPDX-License-Identifier: Apache-2.0
"""The centre of a mark by weighted least squares of its image model, with its uncertainty.

The noise of dark and bright pixels is that of the residuals; the covariance of the centre is that
of the weighted fit, its Cramér-Rao bound for normal noise.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from selfcal_ros.vision.models import SMALLEST_BLUR, MarkModel

ROUNDS, WEIGHTED_ROUNDS = 25, (2, 8)
"""Largest number of unweighted steps, smallest and largest number of weighted ones."""
FEW = 600
"""Pixels of the unweighted fit, at least, where a mark has more."""
SETTLED = 1e-3
"""Step of the centre, px, below which the unweighted fit has converged."""
WEIGHTED_DAMPING = 1e-3
"""Of the weighted steps: a thin line is hard to tell from a wider and fainter one."""
SETTLED_SIGMAS = 0.1
"""Step of each parameter, in standard uncertainties for the others known, below which the weighted
fit has converged."""
STAIN, STAIN_SIGMAS = 0.05, 6.0
"""Residual beyond which a pixel is stained: part of the contrast, and standard deviations of
noise; the larger one counts."""
CLEAR = 0.1
"""Shape below which a pixel counts as ground, and one minus shape below which as mark."""
ENOUGH = 20
"""Pixels of ground and of mark needed to tell their noises apart."""
MAD = 1.4826
"""Standard deviation over median absolute deviation, normal noise."""
LIGHTING = 4
"""Parameters before those of the shape: ground, contrast, slopes of the illumination."""


@dataclass(frozen=True)
class Disc:
    """Places of the pixels of a disc.

    Attributes
    ----------
    u, v : float arrays (n,)
        Places of its pixels relative to its centre.
    inside : bool array (h, w)
        Which pixels of the square around it are in it.
    near : float array (n,)
        Part of the 3 x 3 pixels around each one that is in it.
    """

    u: np.ndarray
    v: np.ndarray
    inside: np.ndarray
    near: np.ndarray


@dataclass(frozen=True)
class Window:
    """Values (n,) of an image in a disc."""

    disc: Disc
    value: np.ndarray


@dataclass(frozen=True)
class Fit:
    """The fit of a mark.

    Attributes
    ----------
    centre : float array (2,)
        Its centre relative to the window's, px.
    covariance : float array (2, 2)
        Of the centre, px².
    shape : dict
        Name of a shape parameter -> its value.
    contrast, noise : float
        Mark minus ground, and standard deviation of a pixel.
    explained : float
        Part of the variance of the window that the model explains.
    bright, dark, inner_stains, outer_stains : int
        Stained pixels: brighter than mark and ground or darker than both, else inside of the mark
        or outside.
    """

    centre: np.ndarray
    covariance: np.ndarray
    shape: dict[str, float]
    contrast: float
    noise: float
    explained: float
    bright: int
    dark: int
    inner_stains: int
    outer_stains: int


@lru_cache(maxsize=2)
def _disc(radius: float) -> Disc:
    half = int(np.ceil(radius))
    v, u = np.mgrid[-half:half + 1, -half:half + 1].astype(float)
    inside = u * u + v * v <= radius * radius
    near = ndimage.uniform_filter(inside.astype(float), 3, mode="constant")
    return Disc(u[inside], v[inside], inside, near[inside])


def window_of(image: np.ndarray, column: int, row: int, radius: float) -> Window | None:
    """Return the window around a pixel; None if it reaches beyond the image."""
    half = int(np.ceil(radius))
    if not (half <= column < image.shape[1] - half and half <= row < image.shape[0] - half):
        return None
    disc = _disc(radius)
    part = image[row - half:row + half + 1, column - half:column + half + 1]
    return Window(disc, part[disc.inside].astype(float))


def _image(model: MarkModel, u: np.ndarray, v: np.ndarray, p: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the modelled image (n,), its derivatives (6 + shape, n) and the shape (n,).

    Parameters: centre u and v, ground, contrast, slopes of the illumination, shape.
    """
    shape, by = model.shape(u - p[0], v - p[1], p[2 + LIGHTING:])
    light = 1 + p[4] * u + p[5] * v
    level, bright = p[2] + p[3] * shape, p[3] * light
    jacobian = np.empty((len(p), len(u)))
    np.multiply(by[:2], bright, out=jacobian[:2])
    np.multiply(by[2:], bright, out=jacobian[2 + LIGHTING:])
    jacobian[2] = light
    for row, (one, other) in enumerate(((light, shape), (level, u), (level, v)), start=3):
        np.multiply(one, other, out=jacobian[row])
    return level * light, jacobian, shape


def _first(shape: np.ndarray, value: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the first parameters: levels by linear least squares at the centre of the window."""
    away = shape - shape.mean()
    contrast = float(away @ value) / max(float(away @ away), 1e-300)
    return np.concatenate([
        [0.0, 0.0, value.mean() - contrast * shape.mean(), contrast, 0.0, 0.0], start])


def _normal(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix of diagonal 1, and the scale of each parameter."""
    normal = jacobian @ jacobian.T
    scale = np.sqrt(np.diagonal(normal)) + 1e-300
    return normal / scale / scale[:, None], scale


def _solved(jacobian: np.ndarray, residual: np.ndarray, damping: float) -> np.ndarray:
    normal, scale = _normal(jacobian)
    normal[np.diag_indices_from(normal)] += damping
    return np.linalg.solve(normal, jacobian @ residual / scale) / scale


def _diverged(p: np.ndarray, radius: float) -> bool:
    return not (np.hypot(*p[:2]) <= radius / 2 and np.abs(p[2 + LIGHTING:]).max() < 10 * radius)


def _settled(model: MarkModel, window: Window, start: np.ndarray) -> np.ndarray | None:
    """Return the parameters of the unweighted fit; None if it does not converge (Marquardt).

    It is a start for the weighted one: some of the pixels of a large mark serve.
    """
    some = slice(None, None, max(1, len(window.value) // FEW))
    u, v, value = window.disc.u[some], window.disc.v[some], window.value[some]
    p = _first(model.shape(u, v, start)[0], value, start)
    damping, (image, jacobian, _) = 1e-3, _image(model, u, v, p)
    residual = value - image
    cost = residual @ residual
    radius = window.disc.inside.shape[0] / 2
    for _ in range(ROUNDS):
        step = _solved(jacobian, residual, damping)
        tried = p + step
        tried[-1] = max(tried[-1], SMALLEST_BLUR)
        if _diverged(tried, radius) or ("width" in model.names and (tried[6:8] <= 0).any()):
            damping *= 10
            continue
        image, new_jacobian, _ = _image(model, u, v, tried)
        new_residual = value - image
        new_cost = new_residual @ new_residual
        if new_cost > cost:
            damping *= 10
            if np.hypot(*step[:2]) < SETTLED:
                return p
            continue
        p, residual, jacobian, cost, damping = (
            tried, new_residual, new_jacobian, new_cost, damping / 10)
        if np.hypot(*step[:2]) < SETTLED and damping < 1e-3:
            return p
    return None


def _median(values: np.ndarray) -> float:
    """Return the median of at least one value, faster than numpy's for some thousands."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ranked = np.partition(values, (low, high))
    return float(ranked[low] + ranked[high]) / 2


def _noise(residual: np.ndarray, image: np.ndarray, shape: np.ndarray, used: np.ndarray,
           free: int) -> np.ndarray:
    """Return the variance of each pixel, linear in its value between those of ground and mark."""
    square, factor = np.square(residual), used.sum() / max(used.sum() - free, 1)
    mean = max(square[used].mean() * factor, 1e-12)
    ground, mark = used & (shape < CLEAR), used & (shape > 1 - CLEAR)
    if min(ground.sum(), mark.sum()) < ENOUGH:
        return np.full(len(residual), mean)
    low, high = (max(square[part].mean() * factor, mean / 10) for part in (ground, mark))
    at_low, at_high = image[ground].mean(), image[mark].mean()
    if at_low == at_high:
        return np.full(len(residual), mean)
    line = low + (high - low) * (image - at_low) / (at_high - at_low)
    return np.clip(line, min(low, high), max(low, high))


def fitted(model: MarkModel, window: Window, start: np.ndarray) -> Fit | None:
    """Fit a mark near the centre of a window; None if there is none.

    Parameters
    ----------
    model
        The kind of mark.
    window
        The part of the image.
    start : float array
        First parameters of the shape.
    """
    try:
        p = _settled(model, window, start)
        return None if p is None or not p[3] else _weighted(model, window, p)
    except np.linalg.LinAlgError:  # a shape without size or width
        return None


def _weighted(model: MarkModel, window: Window, p: np.ndarray) -> Fit | None:
    """Return the weighted fit from parameters `p`; None if it diverges or too much is stained."""
    disc = window.disc
    for done in range(1, WEIGHTED_ROUNDS[1] + 1):
        image, jacobian, shape = _image(model, disc.u, disc.v, p)
        residual = window.value - image
        limit = max(STAIN * abs(p[3]), STAIN_SIGMAS * MAD * _median(np.abs(residual)))
        used = np.abs(residual) <= limit
        if used.sum() < 2 * len(p):
            return None
        variance = _noise(residual, image, shape, used, len(p))
        root = np.where(used, 1 / np.sqrt(variance), 0.0)
        weighted = jacobian * root
        normal, scale = _normal(weighted)
        damped = normal + WEIGHTED_DAMPING * np.eye(len(p))
        sigmas = np.linalg.solve(damped, weighted @ (residual * root) / scale)
        p = p + sigmas / scale
        p[-1] = max(p[-1], SMALLEST_BLUR)
        if _diverged(p, disc.inside.shape[0] / 2):
            return None
        if done >= WEIGHTED_ROUNDS[0] and np.abs(sigmas).max() < SETTLED_SIGMAS:
            break
    covariance = np.linalg.inv(normal)[:2, :2] / scale[:2] / scale[:2, None]
    total = np.square(window.value - window.value.mean()).sum()
    stains = _stains(window, image, shape, p)
    return Fit(p[:2], covariance, dict(zip(model.names, p[6:].tolist(), strict=True)), float(p[3]),
               _median(variance) ** 0.5,
               float(1 - residual @ residual / max(total, 1e-300)), *stains)


def _stains(window: Window, image: np.ndarray, shape: np.ndarray, p: np.ndarray,
            ) -> tuple[int, int, int, int]:
    """Count stained pixels in the residuals averaged over 3 x 3 pixels, by their kind."""
    residual = window.value - image
    disc = window.disc
    square = np.zeros(disc.inside.shape)
    square[disc.inside] = residual
    mean = ndimage.uniform_filter(square, 3, mode="constant")[disc.inside] / disc.near
    noise = MAD * _median(np.abs(residual)) / np.sqrt(9 * disc.near)
    least = STAIN * abs(p[3])
    stained = (np.abs(mean) > np.maximum(least, STAIN_SIGMAS * noise)) & (np.abs(residual) > least)
    levels = [_median(window.value[part]) if part.any() else level for part, level in (
        (shape < CLEAR, p[2]), (shape > 1 - CLEAR, p[2] + p[3]))]  # robust, as the fit is not
    beyond = 0.25 * (max(levels) - min(levels))
    bright = stained & (mean > 0) & (window.value > max(levels) + beyond)
    dark = stained & (mean < 0) & (window.value < min(levels) - beyond)
    other, inner = stained & ~bright & ~dark, shape > 0.5
    return (int(bright.sum()), int(dark.sum()), int((other & inner).sum()),
            int((other & ~inner).sum()))
