# SPDX-License-Identifier: Apache-2.0
"""The datum: what no view can tell, and the first-order parts of a map (method eqs. 3.1-3.4)."""

import numpy as np

from selfcal_ros.model.artifact import Artifact


def datum_modes(artifact: Artifact, *, scale: bool) -> np.ndarray:
    """Return the rigid modes of a map, (modes, 2, nx, ny): two translations, rotation, scale.

    Parameters
    ----------
    artifact : Artifact
        Lattice of the map.
    scale : bool
        Whether magnification belongs to the datum (stage: yes, plate: no).
    """
    x, y = artifact.x_m, artifact.y_m
    one, zero = np.ones(artifact.shape), np.zeros(artifact.shape)
    modes = [(one, zero), (zero, one), (-y, x)]
    return np.array([*modes, (x, y)] if scale else modes)


def remove_modes(field_m: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Return `field_m` (2, nx, ny) without its least-squares part in `modes`, over known sites.

    Sites with NaN stay NaN and do not count. With the modes of `datum_modes` the result
    satisfies Hu eq. 5 (stage) or eq. 11 (plate).
    """
    known = np.isfinite(field_m).all(axis=0)
    basis = modes[:, :, known].reshape(len(modes), -1).T
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    coefficients = np.linalg.lstsq(basis, field_m[:, known].ravel(), rcond=None)[0]
    out = field_m.copy()
    out[:, known] -= (basis @ coefficients).reshape(2, -1)
    return out


def axis_slopes(artifact: Artifact, gx_m: np.ndarray, gy_m: np.ndarray) -> np.ndarray:
    """Return the slopes of the XY error along the four half axes, rad (Hu eq. 27).

    They are the angular errors at lines 0, K/4, K/2, 3K/4: ordinary least squares with
    intercept; +Gy on x along +-X, -Gx on y along +-Y. NaN where fewer than two sites are known.
    """
    hx, hy = artifact.half
    pitch = artifact.grid_pitch_m
    along = ((gy_m[hx + 1:, hy], np.arange(1, hx + 1)), (-gx_m[hx, hy + 1:], np.arange(1, hy + 1)),
             (gy_m[:hx, hy], np.arange(-hx, 0)), (-gx_m[hx, :hy], np.arange(-hy, 0)))
    return np.array([_slope(values, steps * pitch) for values, steps in along])


def _slope(values: np.ndarray, positions: np.ndarray) -> float:
    known = np.isfinite(values)
    if known.sum() < 2:
        return float("nan")
    centred = positions[known] - positions[known].mean()
    return float(centred @ values[known] / (centred @ centred))


def slope_rows(z_m: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the slopes of `datum.axis_slopes` as rows over the sites, complex (4, nx, ny).

    A row of zeros stands for a half axis with fewer than two known sites.

    Parameters
    ----------
    z_m : complex array (nx, ny)
        Site positions, m.
    known : bool array (nx, ny)
        Sites that count.
    """
    hx, hy = (size // 2 for size in z_m.shape)
    out = np.zeros((4, *z_m.shape), dtype=complex)
    halves = ((np.s_[hx + 1:, hy], 1j), (np.s_[hx, hy + 1:], -1), (np.s_[:hx, hy], 1j),
              (np.s_[hx, :hy], -1))
    for row, (part, unit) in zip(out, halves, strict=True):
        good = known[part]
        if good.sum() >= 2:
            at = (z_m[part].real + z_m[part].imag) * good
            centred = (at - at.sum() / good.sum()) * good
            row[part] = unit * centred / (centred @ centred)
    return out


def first_order(artifact: Artifact, gx_m: np.ndarray, gy_m: np.ndarray) -> tuple[float, float]:
    """Return non-orthogonality O and scale difference R of a map (Hu eq. 6).

    Gx = O y + R x + Fx, Gy = O x - R y + Fy, with F free of first-order parts: the
    least-squares coefficients over the known sites.
    """
    x, y = artifact.x_m, artifact.y_m
    shear = np.array([[(y, x), (x, -y)]])[0]
    modes = np.concatenate([datum_modes(artifact, scale=True), shear])
    known = np.isfinite(gx_m) & np.isfinite(gy_m)
    basis = modes[:, :, known].reshape(len(modes), -1).T
    norms = np.linalg.norm(basis, axis=0)
    values = np.concatenate([gx_m[known], gy_m[known]])
    fit = np.linalg.lstsq(basis / norms, values, rcond=None)[0] / norms
    return float(fit[4]), float(fit[5])
