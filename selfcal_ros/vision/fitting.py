# SPDX-License-Identifier: Apache-2.0
"""The centres of marks by weighted least squares of their image model, with uncertainty.

Many marks are fitted at once: arrays have a row for each mark, so that an image of thousands of
marks costs a fraction of a millisecond each.

The noise of dark and bright pixels is that of the residuals; the uncertainty of the centre is that
of the weighted fit, its Cramér-Rao bound for normal noise.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from selfcal_ros.collection.marks.repeats import row_medians
from selfcal_ros.vision.models import SMALLEST_BLUR, MarkModel

ROUNDS, WEIGHTED_ROUNDS = 25, (2, 8)
"""Largest number of unweighted steps, smallest and largest number of weighted ones."""
FEW = 200
"""Pixels of the unweighted fit, at least, where a mark has more; all if it fails with these."""
SETTLED = 0.02
"""Step of the centre, px, below which the unweighted fit has converged, for the weighted one."""
WEIGHTED_DAMPING = 1e-3
"""Of the weighted steps: a thin line is hard to tell from a wider and fainter one."""
SETTLED_SIGMAS = 0.1
"""Step of each parameter, in standard uncertainties for the others known, below which the weighted
fit has converged."""
STAIN, STAIN_SIGMAS = 0.08, 6.0
"""Residual beyond which a pixel is stained: part of the contrast, and standard deviations of
noise; the larger one counts. Lenses leave residuals of 5 to 8 % of the contrast at the edge of the
field of a photograph. They shift centres: over the whole field their scatter is 0.010 px beside a
stated u of 0.0095 px, but at its edge one centre in twenty is off by more than 0.065 px.
Curvatures of the illumination would accept 67 more marks of that photograph, in the penumbra of
its beam: their centres lie up to 1.3 px off, with a stated u of 0.03 px."""
CLEAR = 0.1
"""Shape below which a pixel counts as ground, and one minus shape below which as mark."""
ENOUGH = 20
"""Pixels of ground and of mark needed to tell their noises apart."""
MAD = 1.4826
"""Standard deviation over median absolute deviation, normal noise."""
TOGETHER = 80_000
"""Pixels that are fitted at once, about: more do not fit into a processor's cache."""
PRECISION = np.float32
"""Type of the pixels and of what is modelled of them, in two thirds of the time of float64: its
rounding shifts a centre by less than a hundredth of its uncertainty, 16 bits and no noise
included. Parameters are float64."""
TINY = float(np.finfo(PRECISION).tiny)
"""Instead of zero, where it would divide."""
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
class Windows:
    """Values (marks, n) of an image in a disc around each mark."""

    disc: Disc
    values: np.ndarray


@dataclass(frozen=True)
class Fit:
    """The fit of a mark.

    Attributes
    ----------
    centre : float array (2,)
        Its centre relative to the window's, px.
    sigmas : tuple (2,)
        Standard uncertainties of the centre, px.
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
    sigmas: tuple[float, float]
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
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(PRECISION)
    inside = u * u + v * v <= radius * radius
    near = ndimage.uniform_filter(inside.astype(PRECISION), 3, mode="constant")
    return Disc(u[inside], v[inside], inside, near[inside])


def lie_inside(
    image: np.ndarray, columns: np.ndarray, rows: np.ndarray, radius: float
) -> np.ndarray:
    """Return which windows (marks,) around pixels lie inside the image."""
    half = int(np.ceil(radius))
    height, width = image.shape
    return (
        (half <= columns)
        & (columns < width - half)
        & (half <= rows)
        & (rows < height - half)
    )


def windows_of(
    image: np.ndarray, columns: np.ndarray, rows: np.ndarray, radius: float
) -> Windows:
    """Return the windows around pixels; each must lie inside the image."""
    disc = _disc(radius)
    across, down = disc.u.astype(int), disc.v.astype(int)
    return Windows(
        disc, image[rows[:, None] + down, columns[:, None] + across].astype(PRECISION)
    )


def fit_marks(
    model: MarkModel, windows: Windows, starts: np.ndarray
) -> list[Fit | None]:
    """Fit a mark near the centre of each window; None where there is none.

    Parameters
    ----------
    model
        The kind of mark.
    windows
        The parts of the image.
    starts : float array (marks, shape)
        First parameters of the shapes.
    """
    together = max(1, TOGETHER // max(1, windows.values.shape[1]))
    fits: list[Fit | None] = []
    for first in range(0, len(windows.values), together):
        some = slice(first, first + together)
        part = Windows(windows.disc, windows.values[some])
        fits += _fitted(model, part, starts[some])
    return fits


def _fitted(model: MarkModel, windows: Windows, starts: np.ndarray) -> list[Fit | None]:
    fits: list[Fit | None] = [None] * len(starts)
    step = max(1, windows.values.shape[1] // FEW)
    parameters, settled = _unweighted_fits(model, windows, starts, step)
    if step > 1 and not settled.all():
        noisy = Windows(windows.disc, windows.values[~settled])
        parameters[~settled], settled[~settled] = _unweighted_fits(
            model, noisy, starts[~settled], 1
        )
    settled &= parameters[:, 3] != 0
    which = np.flatnonzero(settled)
    some = Windows(windows.disc, windows.values[which])
    for index, fit in zip(
        which, _weighted(model, some, parameters[which]), strict=True
    ):
        fits[index] = fit
    return fits


def _image(
    model: MarkModel, u: np.ndarray, v: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return modelled images (marks, n), derivatives (marks, 6 + shape, n), shapes (marks, n).

    Parameters `p` (marks, 6 + shape): centre u and v, ground, contrast, slopes of the
    illumination, shape.
    """
    columns = p.T[..., None].astype(PRECISION)
    shape, derivatives = model.shape(
        u - columns[0], v - columns[1], columns[2 + LIGHTING :]
    )
    light = 1 + columns[4] * u + columns[5] * v
    level = columns[2] + columns[3] * shape
    bright = columns[3] * light
    jacobian = np.empty((len(p), p.shape[1], len(u)), dtype=PRECISION)
    for row, derivative in zip(
        (0, 1, *range(2 + LIGHTING, p.shape[1])), derivatives, strict=True
    ):
        np.multiply(derivative, bright, out=jacobian[:, row])
    jacobian[:, 2] = light
    for row, (factor, values) in enumerate(
        ((light, shape), (level, u), (level, v)), start=3
    ):
        np.multiply(factor, values, out=jacobian[:, row])
    return level * light, jacobian, shape


def _first(shape: np.ndarray, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the first parameters: levels by linear least squares at the centre of the window."""
    away = shape - shape.mean(axis=1, keepdims=True)
    contrast = _dot(away, values) / np.maximum(_dot(away, away), TINY)
    first = np.zeros((len(values), 2 + LIGHTING))
    first[:, 2] = values.mean(axis=1) - contrast * shape.mean(axis=1)
    first[:, 3] = contrast
    return np.hstack([first, starts])


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the inner product of each pair of rows."""
    return np.einsum("mn,mn->m", a, b)


def _normal(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normal matrices of diagonal 1, and the scales of the parameters (marks, p)."""
    normal = (jacobian @ jacobian.transpose(0, 2, 1)).astype(float)
    scale = np.sqrt(np.diagonal(normal, axis1=1, axis2=2)) + TINY
    return normal / scale[:, None, :] / scale[:, :, None], scale


def _solutions(solver: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """Return the solution of each mark; NaN where its matrix is singular."""
    try:
        return solver(*arrays)
    except np.linalg.LinAlgError:  # a shape without size or width
        pass
    solutions = np.full_like(arrays[-1], np.nan)
    for index in range(len(solutions)):
        try:
            solutions[index] = solver(*(array[index] for array in arrays))
        except np.linalg.LinAlgError:
            continue
    return solutions


def _solved(
    jacobian: np.ndarray, residual: np.ndarray, damping: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the damped steps (marks, p), the normal matrices and the scales."""
    normal, scale = _normal(jacobian)
    damped = normal + damping[:, None, None] * np.eye(normal.shape[1])
    gradient = (jacobian @ residual[..., None])[..., 0] / scale
    return (
        _solutions(np.linalg.solve, damped, gradient[..., None])[..., 0],
        normal,
        scale,
    )


def _diverged(p: np.ndarray, radius: float) -> np.ndarray:
    near = np.hypot(p[:, 0], p[:, 1]) <= radius / 2
    return ~(near & (np.abs(p[:, 2 + LIGHTING :]).max(axis=1) < 10 * radius))


def _unweighted_fits(
    model: MarkModel, windows: Windows, starts: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters of the unweighted fits, and which converged (Marquardt).

    They are a start for the weighted ones: every `step`-th pixel of a mark serves.
    """
    some = slice(None, None, step)
    u = windows.disc.u[some]
    v = windows.disc.v[some]
    values = windows.values[:, some]
    radius = windows.disc.inside.shape[0] / 2
    p = _first(
        model.shape(u, v, starts.T[..., None].astype(PRECISION))[0], values, starts
    )
    image, jacobian, _ = _image(model, u, v, p)
    residual = values - image
    cost = _dot(residual, residual)
    damping = np.full(len(p), 1e-3)
    settled = np.zeros(len(p), dtype=bool)
    running = np.arange(len(p))
    for _ in range(ROUNDS):
        if not len(running):
            break
        sigmas, _, scale = _solved(
            jacobian[running], residual[running], damping[running]
        )
        change = sigmas / scale
        tried = p[running] + change
        tried[:, -1] = np.maximum(tried[:, -1], SMALLEST_BLUR)
        possible = ~_diverged(tried, radius)
        if "width" in model.names:
            possible &= (tried[:, 6:8] > 0).all(axis=1)
        lost = np.isnan(change).any(axis=1)
        image, new_jacobian, _ = _image(
            model, u, v, np.where(possible[:, None], tried, p[running])
        )
        new_residual = values[running] - image
        new_cost = _dot(new_residual, new_residual)
        better = possible & (new_cost <= cost[running])
        small = np.hypot(change[:, 0], change[:, 1]) < SETTLED

        improved = running[better]
        p[improved], residual[improved], jacobian[improved] = (
            tried[better],
            new_residual[better],
            new_jacobian[better],
        )
        cost[improved] = new_cost[better]
        damping[running] *= np.where(better, 0.1, 10.0)
        converged = small & possible & (~better | (damping[running] < 1e-3))
        settled[running[converged]] = True
        running = running[~converged & ~lost]
    return p, settled


def _variance(
    residual: np.ndarray,
    image: np.ndarray,
    shape: np.ndarray,
    used: np.ndarray,
    free: int,
) -> np.ndarray:
    """Return the variance of each pixel, linear in its value between those of ground and mark."""
    square = np.square(residual)
    count = used.sum(axis=1)
    factor = count / np.maximum(count - free, 1)

    def mean_of(values: np.ndarray, part: np.ndarray) -> np.ndarray:
        return _dot(values, part.astype(PRECISION)) / np.maximum(part.sum(axis=1), 1)

    mean = np.maximum(mean_of(square, used) * factor, 1e-12)
    on_ground = used & (shape < CLEAR)
    on_mark = used & (shape > 1 - CLEAR)
    low, high = (
        np.maximum(mean_of(square, part) * factor, mean / 10)
        for part in (on_ground, on_mark)
    )
    at_low, at_high = mean_of(image, on_ground), mean_of(image, on_mark)
    apart = (np.minimum(on_ground.sum(axis=1), on_mark.sum(axis=1)) >= ENOUGH) & (
        at_low != at_high
    )
    low, high = np.where(apart, low, mean), np.where(apart, high, mean)
    slope = (high - low) / np.where(apart, at_high - at_low, 1.0)
    low, high, slope, at_low = (
        column[:, None].astype(PRECISION) for column in (low, high, slope, at_low)
    )
    return np.clip(
        low + slope * (image - at_low), np.minimum(low, high), np.maximum(low, high)
    )


def _weighted(model: MarkModel, windows: Windows, p: np.ndarray) -> list[Fit | None]:
    """Return the weighted fits from parameters `p`.

    None for a fit that diverges, or of which too much is stained.
    """
    disc = windows.disc
    fitted: list[Fit | None] = [None] * len(p)
    running = np.arange(len(p))
    for rounds in range(1, WEIGHTED_ROUNDS[1] + 1):
        if not len(running):
            break
        values = windows.values[running]
        before = p[running]
        image, jacobian, shape = _image(model, disc.u, disc.v, before)
        residual = values - image
        spread = MAD * row_medians(np.abs(residual))
        limit = np.maximum(STAIN * np.abs(before[:, 3:4]), STAIN_SIGMAS * spread)
        used = np.abs(residual) <= limit
        enough = used.sum(axis=1) >= 2 * p.shape[1]
        variance = _variance(residual, image, shape, used, p.shape[1])
        root = used / np.sqrt(variance)
        sigmas, normal, scale = _solved(
            jacobian * root[:, None, :],
            residual * root,
            np.full(len(running), WEIGHTED_DAMPING),
        )
        after = before + sigmas / scale
        after[:, -1] = np.maximum(after[:, -1], SMALLEST_BLUR)
        usable = enough & ~_diverged(after, disc.inside.shape[0] / 2)
        settled = np.abs(sigmas).max(axis=1) < SETTLED_SIGMAS
        last = rounds == WEIGHTED_ROUNDS[1]
        ready = usable & (last | ((rounds >= WEIGHTED_ROUNDS[0]) & settled))
        p[running] = after
        if ready.any():
            fits = _fits(
                model,
                Windows(disc, values[ready]),
                after[ready],
                (shape[ready], residual[ready], variance[ready], spread[ready]),
                (normal[ready], scale[ready]),
            )
            for index, fit in zip(running[ready], fits, strict=True):
                fitted[index] = fit
        running = running[usable & ~ready]
    return fitted


def _fits(
    model: MarkModel,
    windows: Windows,
    p: np.ndarray,
    modelled: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    normal_and_scale: tuple[np.ndarray, np.ndarray],
) -> list[Fit | None]:
    """Return the fits of marks that have settled; None where the uncertainty is not known."""
    shape, residual, variance, spread = modelled
    normal, scale = normal_and_scale
    variances = np.diagonal(_solutions(np.linalg.inv, normal), axis1=1, axis2=2)[
        :, :2
    ].copy()
    # rounding, of a matrix that is almost singular
    variances[~(variances > 0)] = np.nan
    sigmas = np.sqrt(variances) / scale[:, :2]
    away = windows.values - windows.values.mean(axis=1, keepdims=True)
    explained = 1 - _dot(residual, residual) / np.maximum(_dot(away, away), TINY)
    noise = np.sqrt(row_medians(variance)[:, 0])
    stains = _stains(windows, (shape, residual, spread), p)
    return [
        Fit(
            p[i, :2],
            tuple(sigmas[i].tolist()),
            dict(zip(model.names, p[i, 6:].tolist(), strict=True)),
            float(p[i, 3]),
            float(noise[i]),
            float(explained[i]),
            *stains[i].tolist(),
        )
        if np.isfinite(sigmas[i]).all()
        else None
        for i in range(len(p))
    ]


def _stains(
    windows: Windows, modelled: tuple[np.ndarray, np.ndarray, np.ndarray], p: np.ndarray
) -> np.ndarray:
    """Count stained pixels in the residuals averaged over 3 x 3 pixels, by their kind (marks, 4).

    The order is that of `Fit`: bright, dark, inner, outer.
    """
    disc = windows.disc
    shape, residual, spread = modelled
    squares = np.zeros((len(p), *disc.inside.shape), dtype=PRECISION)
    squares[:, disc.inside] = residual
    mean = (
        ndimage.uniform_filter(squares, (0, 3, 3), mode="constant")[:, disc.inside]
        / disc.near
    )
    noise = spread / np.sqrt(9 * disc.near)
    least = STAIN * np.abs(p[:, 3:4])
    stained = (np.abs(mean) > np.maximum(least, STAIN_SIGMAS * noise)) & (
        np.abs(residual) > least
    )

    counts = np.zeros((len(p), 4), dtype=int)
    some = stained.any(axis=1)  # the levels of the others are not wanted
    p, values, shape, mean, stained = (
        array[some] for array in (p, windows.values, shape, mean, stained)
    )
    levels = np.stack(
        [
            _median_of_part(values, shape < CLEAR, p[:, 2]),
            _median_of_part(values, shape > 1 - CLEAR, p[:, 2] + p[:, 3]),
        ]
    )
    low, high = levels.min(axis=0)[:, None], levels.max(axis=0)[:, None]
    beyond = 0.25 * (high - low)
    bright = stained & (mean > 0) & (values > high + beyond)
    dark = stained & (mean < 0) & (values < low - beyond)
    neither = stained & ~bright & ~dark
    inner = shape > 0.5
    counts[some] = np.stack(
        [
            part.sum(axis=1)
            for part in (bright, dark, neither & inner, neither & ~inner)
        ],
        axis=1,
    )
    return counts


def _median_of_part(
    values: np.ndarray, part: np.ndarray, level: np.ndarray
) -> np.ndarray:
    """Return the median of the values in a part of each window; `level` where it is empty.

    It is robust, as the levels of the fit are not.
    """
    count = part.sum(axis=1)
    ranked = np.sort(np.where(part, values, np.inf), axis=1)
    rows = np.arange(len(values))
    low = np.maximum(count - 1, 0) // 2
    high = count // 2
    with np.errstate(invalid="ignore"):  # inf - inf where there is none
        middle = (
            ranked[rows, low] + ranked[rows, np.minimum(high, values.shape[1] - 1)]
        ) / 2
    return np.where(count > 0, middle, level)
