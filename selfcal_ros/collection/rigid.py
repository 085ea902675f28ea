# SPDX-License-Identifier: Apache-2.0
"""A view's own rotation and offset, estimated robustly to tell marks apart."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rigid:
    """A small turn and an offset: deviation = phi J p + t; rad and m, stage frame."""

    phi_rad: float = 0.0
    tx_m: float = 0.0
    ty_m: float = 0.0

    def at(self, p: np.ndarray) -> np.ndarray:
        """Return the deviation at nominal positions `p` (2, n) about the plate centre."""
        turn, one = np.sin(self.phi_rad), np.cos(self.phi_rad) - 1
        return np.stack([one * p[0] - turn * p[1] + self.tx_m,
                         turn * p[0] + one * p[1] + self.ty_m])


def fit_rigid(p: np.ndarray, deviation: np.ndarray) -> Rigid:
    """Fit a rigid motion to deviations, without those that lie far off.

    Parameters
    ----------
    p : float array (2, n)
        Nominal positions about the plate centre, m.
    deviation : float array (2, n)
        Reading minus nominal, m.

    Returns
    -------
    Rigid
        From the median start, five rounds of least squares over the deviations within three
        times the median distance. With fewer than three marks only an offset is fitted.
    """
    if not p.shape[1]:
        return Rigid()
    offset = np.median(deviation, axis=1)
    radius2 = (p**2).sum(axis=0)
    if p.shape[1] < 3 or not radius2.any():
        return Rigid(0.0, float(offset[0]), float(offset[1]))
    lever = np.stack([-p[1], p[0]])
    rim = radius2 >= np.median(radius2)
    phi = np.median(((deviation - offset[:, None]) * lever).sum(axis=0)[rim] / radius2[rim])
    fit = np.array([phi, *offset])
    for _ in range(5):
        distance = np.hypot(*(deviation - fit[0] * lever - fit[1:, None]))
        keep = distance <= 3 * np.median(distance) + 1e-9
        centre = p[:, keep].mean(axis=1, keepdims=True)
        arm = np.stack([-(p - centre)[1], (p - centre)[0]])[:, keep]
        mean = deviation[:, keep].mean(axis=1)
        power = (arm**2).sum()
        phi = (arm * (deviation[:, keep] - mean[:, None])).sum() / power if power > 0 else 0.0
        fit = np.array([phi, *(mean - phi * np.array([-centre[1, 0], centre[0, 0]]))])
    return Rigid(float(fit[0]), float(fit[1]), float(fit[2]))
