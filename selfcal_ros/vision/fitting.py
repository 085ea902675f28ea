# SPDX-License-Identifier: Apache-2.0
"""The centre of a mark by weighted least squares of its image model, with its uncertainty.

The noise of dark and bright pixels is that of the residuals; the covariance of the centre is that
of the weighted fit, its Cramér-Rao bound for normal noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from selfcal_ros.vision.models import SMALLEST_BLUR, MarkModel

ROUNDS, WEIGHTED_ROUNDS = 25, 2
"""Largest number of unweighted steps, and number of weighted ones."""
SETTLED = 1e-3
"""Step of the centre, px, below which the unweighted fit has converged."""
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
class Window:
    """Part of an image around a mark, a disc.

    Attributes
    ----------
    u, v : float arrays (n,)
        Places of its pixels relative to its centre.
    value : float array (n,)
        Their values.
    inside : bool array (h, w)
        Which pixels of the square around it are in it.
    """

    u: np.ndarray
    v: np.ndarray
    value: np.ndarray
    inside: np.ndarray


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


def window_of(image: np.ndarray, column: int, row: int, radius: float) -> Window | None:
    """Return the window around a pixel; None if it reaches beyond the image."""
    half = int(np.ceil(radius))
    if not (half <= column < image.shape[1] - half and half <= row < image.shape[0] - half):
        return None
    v, u = np.mgrid[-half:half + 1, -half:half + 1].astype(float)
    inside = u * u + v * v <= radius * radius
    part = image[row - half:row + half + 1, column - half:column + half + 1]
    return Window(u[inside], v[inside], part[inside].astype(float), inside)


def _image(model: MarkModel, window: Window, p: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the modelled image (n,), its derivatives (n, 6 + shape) and the shape (n,).

    Parameters: centre u and v, ground, contrast, slopes of the illumination, shape.
    """
    u, v = window.u, window.v
    shape, by = model.shape(u - p[0], v - p[1], p[2 + LIGHTING:])
    light = 1 + p[4] * u + p[5] * v
    level = p[2] + p[3] * shape
    jacobian = np.empty((len(u), len(p)))
    jacobian[:, [0, 1]] = by[:, :2] * (p[3] * light)[:, None]
    jacobian[:, 2 + LIGHTING:] = by[:, 2:] * (p[3] * light)[:, None]
    jacobian[:, 2], jacobian[:, 3] = light, light * shape
    jacobian[:, 4], jacobian[:, 5] = level * u, level * v
    return level * light, jacobian, shape


def _first(model: MarkModel, window: Window, shape: np.ndarray) -> np.ndarray:
    """Return the first parameters: levels by linear least squares at the centre of the window."""
    value, _ = model.shape(window.u, window.v, shape)
    ground, contrast = np.linalg.lstsq(
        np.stack([np.ones_like(value), value], axis=1), window.value, rcond=None)[0]
    return np.concatenate([[0.0, 0.0, ground, contrast, 0.0, 0.0], shape])


def _solved(jacobian: np.ndarray, residual: np.ndarray, damping: float) -> np.ndarray:
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diagonal(normal)) + 1e-300
    normal = normal / scale / scale[:, None]
    normal[np.diag_indices_from(normal)] += damping
    return np.linalg.solve(normal, jacobian.T @ residual / scale) / scale


def _settled(model: MarkModel, window: Window, p: np.ndarray) -> np.ndarray | None:
    """Return the parameters of the unweighted fit; None if it does not converge (Marquardt)."""
    damping, (image, jacobian, _) = 1e-3, _image(model, window, p)
    cost = np.square(window.value - image).sum()
    radius = np.sqrt(len(window.u) / np.pi)
    for _ in range(ROUNDS):
        step = _solved(jacobian, window.value - image, damping)
        tried = p + step
        tried[-1] = max(tried[-1], SMALLEST_BLUR)
        if np.hypot(*tried[:2]) > radius / 2 or (len(model.names) > 2 and (tried[6:8] <= 0).any()
                                                 and "width" in model.names):
            damping *= 10
            continue
        new_image, new_jacobian, _ = _image(model, window, tried)
        new_cost = np.square(window.value - new_image).sum()
        if new_cost > cost:
            damping *= 10
            if np.hypot(*step[:2]) < SETTLED:
                return p
            continue
        p, image, jacobian, cost, damping = tried, new_image, new_jacobian, new_cost, damping / 10
        if np.hypot(*step[:2]) < SETTLED and damping < 1e-3:
            return p
    return None


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
    p = _settled(model, window, _first(model, window, start))
    if p is None or not p[3]:
        return None
    for _ in range(WEIGHTED_ROUNDS):
        image, jacobian, shape = _image(model, window, p)
        residual = window.value - image
        limit = max(STAIN * abs(p[3]), STAIN_SIGMAS * MAD * float(np.median(np.abs(residual))))
        used = np.abs(residual) <= limit
        if used.sum() < 2 * len(p):
            return None
        variance = _noise(residual, image, shape, used, len(p))
        root = np.where(used, 1 / np.sqrt(variance), 0.0)
        weighted = jacobian * root[:, None]
        p = p + _solved(weighted, residual * root, 1e-12)
        p[-1] = max(p[-1], SMALLEST_BLUR)
    scale = np.sqrt(np.square(weighted).sum(axis=0)) + 1e-300
    normal = weighted.T @ weighted / scale / scale[:, None]
    covariance = np.linalg.inv(normal)[:2, :2] / scale[:2] / scale[:2, None]
    total = np.square(window.value - window.value.mean()).sum()
    stains = _stains(window, image, shape, p)
    return Fit(p[:2], covariance, dict(zip(model.names, p[6:].tolist(), strict=True)), float(p[3]),
               float(np.sqrt(np.median(variance))),
               float(1 - np.square(residual).sum() / max(total, 1e-300)), *stains)


def _stains(window: Window, image: np.ndarray, shape: np.ndarray, p: np.ndarray,
            ) -> tuple[int, int, int, int]:
    """Count stained pixels in the residuals averaged over 3 x 3 pixels, by their kind."""
    residual = window.value - image
    square = np.zeros(window.inside.shape)
    square[window.inside] = residual
    count = ndimage.uniform_filter(window.inside.astype(float), 3, mode="constant")
    mean = (ndimage.uniform_filter(square, 3, mode="constant") / np.maximum(count, 1e-3))[
        window.inside]
    noise = MAD * float(np.median(np.abs(residual))) / np.sqrt(9 * count[window.inside])
    least = STAIN * abs(p[3])
    stained = (np.abs(mean) > np.maximum(least, STAIN_SIGMAS * noise)) & (np.abs(residual) > least)
    levels = [float(np.median(window.value[part])) if part.any() else level for part, level in (
        (shape < CLEAR, p[2]), (shape > 1 - CLEAR, p[2] + p[3]))]  # robust, as the fit is not
    beyond = 0.25 * (max(levels) - min(levels))
    bright = stained & (mean > 0) & (window.value > max(levels) + beyond)
    dark = stained & (mean < 0) & (window.value < min(levels) - beyond)
    other, inner = stained & ~bright & ~dark, shape > 0.5
    return (int(bright.sum()), int(dark.sum()), int((other & inner).sum()),
            int((other & ~inner).sum()))
