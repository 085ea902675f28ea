# SPDX-License-Identifier: Apache-2.0
"""The noise of pixels, and the uncertainty of a centre where bright pixels are much noisier."""

import numpy as np
import pytest

from selfcal_ros.vision.fitting import fit_marks, windows_of
from selfcal_ros.vision.models import MODELS


def fitted(model, image, middle, *, radius, start):
    """Return the fit of one mark in the middle of a square image."""
    at = np.array([middle])
    (fit,) = fit_marks(model, windows_of(image, at, at, radius), start[None])
    return fit


def test_bright_pixels_that_are_noisier_weigh_less():
    """Noise 1 in the dark, 20 in the light: chi² of 60 centres by their own uncertainty."""
    model, rng, ratios = MODELS["disc"], np.random.default_rng(7), []
    v, u = np.mgrid[:61, :61].astype(float)
    for _ in range(60):
        away = rng.uniform(-0.5, 0.5, 2)
        shape = model.shape(
            (u - 30 - away[0]).ravel(),
            (v - 30 - away[1]).ravel(),
            np.array([24.0, 3.0]),
        )[0].reshape(u.shape)
        image = 200 - 150 * shape + rng.normal(size=u.shape) * (20 - 19 * shape)
        fit = fitted(model, image, 30, radius=20.0, start=np.array([24.0, 2.0]))
        ratios.append((fit.centre - away) / fit.sigmas)
    square = np.square(ratios)
    assert abs(square.mean() - 1) < 4 * np.sqrt(2 / square.size)
    assert fit.sigmas == pytest.approx([0.05, 0.05], abs=0.02)


@pytest.mark.parametrize("mark", MODELS)
def test_windows_without_a_mark_are_no_error(mark):
    """Flat, sloping, a step, random, a single bright pixel, waves."""
    model, rng = MODELS[mark], np.random.default_rng(0)
    v, u = np.mgrid[:41, :41].astype(float)
    for size in rng.uniform(6, 24, 6):
        for image in (
            u * 0 + 7,
            u,
            (u > 20) * 100,
            rng.integers(0, 2, u.shape) * 255,
            (np.hypot(u - 20, v - 20) < 1) * 255,
            np.sin(u) * np.sin(v),
        ):
            fit = fitted(
                model,
                image,
                20,
                radius=min(model.reach * size + 2, 20.0),
                start=model.start(size, size / 5, 0.1, 1.0),
            )
            assert fit is None or fit.centre.shape == (2,)
