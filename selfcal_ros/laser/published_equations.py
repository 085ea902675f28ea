# SPDX-License-Identifier: Apache-2.0
"""The new formulation as published: eqs. 3 to 6, one diagonal at a time, 2D.

Here u = a + Ex(x), q = b + Ey(y) are the measured step lengths of a block, v = Ey(x) and
p = Ex(y) the transverse errors. The np diagonal is the pp diagonal of the mirror image of the
machine (X reversed): only v and p change sign.
"""

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.laser.data import Form, StepDiagonal


def eq3(r: np.ndarray, u: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return Ex(y) for Ey(x) = 0 from the length of the diagonal, r = R_x + R_y (eq. 3)."""
    if np.any(r <= q):
        block = int(np.argmax(r <= q)) + 1
        raise InputError(f"block {block}", "the diagonal is shorter than the Y step",
                         "check the units and the steps")
    return np.sqrt(r**2 - q**2) - u


def eq4(u_first: float, half_r_less_delta: float, alpha_2: float) -> float:
    """Return sin(alpha), the mirror's angle to the laser, from the first block (eq. 4).

    Parameters
    ----------
    u_first : float
        a + Ex(x) of the first block.
    half_r_less_delta : float
        R/2 - delta(1), which is R_x of the first block.
    alpha_2 : float
        Angle of the mirror to the Y axis; pi/4 if a = b.
    """
    # Printed with a minus sign that contradicts the geometry of its figure.
    return float(u_first * np.cos(alpha_2) / half_r_less_delta)


def eq5_printed(delta: np.ndarray, sin_alpha: float, alpha_2: float) -> np.ndarray:
    """Return Ey(x) of every block from the change of delta = R/2 - R_x (eq. 5, as printed).

    It assumes the same Ex(x) and half diagonal in every block.
    """
    return -(sin_alpha / np.sin(alpha_2)) * (delta - delta[0])


def eq5_exact(r_x: np.ndarray, u: np.ndarray, sin_alpha: float, alpha_2: float) -> np.ndarray:
    """Return Ey(x) of every block from R_x and the linear error (exact form of eq. 5)."""
    return (r_x * sin_alpha - u * np.cos(alpha_2)) / np.sin(alpha_2)


def eq6(p_0: np.ndarray, v: np.ndarray, u: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return Ex(y) after the modification by Ey(x) (eq. 6, corrected)."""
    gamma = np.arctan2(v, u)
    # Printed with sine and cosine exchanged, which gives a length of about b.
    return p_0 * np.cos(gamma) - q * np.sin(gamma)


def solve_diagonal(data: StepDiagonal, readings_m: np.ndarray, linear_m: np.ndarray, *,
                   form: Form) -> np.ndarray:
    """Return the errors (K, D, n, D) from eqs. 3 to 6 for every diagonal separately.

    Parameters
    ----------
    data : StepDiagonal
        Steps and diagonals of a 2D measurement.
    readings_m : float array (K, 2, n)
        Readings, positive on both diagonals.
    linear_m : float array (2, n)
        Ex(x) and Ey(y).
    form : Form
        ``printed`` uses eq. 5 as printed, ``stepwise`` its exact form.
    """
    if data.dim != 2:
        raise InputError(f"form {form}", "the source gives its equations in 2D only",
                         "use the exact form for body diagonals")
    u, q = linear_m + np.array(data.steps_m)[:, None]
    # The source sets pi/4 "without loss of generality", which is valid for a = b.
    alpha_2 = float(np.arctan2(data.steps_m[1], data.steps_m[0]))
    errors = np.zeros((len(data.diagonals), 2, data.n_blocks, 2))
    for k, (r_x, r_y) in enumerate(readings_m):
        r = r_x + r_y
        delta = r / 2 - r_x
        sin_alpha = eq4(u[0], r[0] / 2 - delta[0], alpha_2)
        if form is Form.PRINTED:
            v = eq5_printed(delta, sin_alpha, alpha_2)
        else:
            v = eq5_exact(r_x, u, sin_alpha, alpha_2)
        p = eq6(eq3(r, u, q), v, u, q)
        reversal = data.signs[k].prod()
        errors[k, 0] = np.stack([linear_m[0], reversal * v], axis=-1)
        errors[k, 1] = np.stack([reversal * p, linear_m[1]], axis=-1)
    return errors
