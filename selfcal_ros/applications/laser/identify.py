# SPDX-License-Identifier: Apache-2.0
"""Both formulations of the step-diagonal measurement, and their common entry point.

The conventional one (Wang; eqs. 1 and 2 of the source) uses the nominal laser directions: it is
valid only if the laser is along the nominal diagonals and the mirror perpendicular to it.
*Erratum*: eq. 1 is printed with its rows for R_y,pp and R_y,np exchanged. The new one (Ibaraki,
Goto, Matsubara) uses measured linear errors and treats laser and mirror as unknown.

Of the second, the paper's own eqs. 3 to 6 treat one diagonal at a time, in 2D: u = a + Ex(x),
q = b + Ey(y) are the measured step lengths of a block, v = Ey(x) and p = Ex(y) the transverse
errors. The np diagonal is the pp diagonal of the mirror image of the machine (X reversed): only v
and p change sign.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.applications.laser.adjust import adjust
from selfcal_ros.applications.laser.data import (
    Closure,
    Form,
    Method,
    StepDiagonal,
    StepDiagonalResult,
    step_vectors,
    turn_to_first_step,
)
from selfcal_ros.applications.laser.noise import (
    CONTRADICTION,
    between_diagonals,
    check_lengths,
    length_closure,
    propagated,
    reading_covariance,
    reading_noise,
    residuals_by_noise,
)
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.model.error_map import rms
from selfcal_ros.units import UM_PER_M


def eq3(r: np.ndarray, u: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return Ex(y) for Ey(x) = 0 from the length of the diagonal, r = R_x + R_y (eq. 3)."""
    if np.any(r <= q):
        block = int(np.argmax(r <= q)) + 1
        raise InputError(
            f"block {block}",
            "the diagonal is shorter than the Y step",
            "check the units and the steps",
        )
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


def eq5_exact(
    r_x: np.ndarray, u: np.ndarray, sin_alpha: float, alpha_2: float
) -> np.ndarray:
    """Return Ey(x) of every block from R_x and the linear error (exact form of eq. 5)."""
    return (r_x * sin_alpha - u * np.cos(alpha_2)) / np.sin(alpha_2)


def eq6(p_0: np.ndarray, v: np.ndarray, u: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return Ex(y) after the modification by Ey(x) (eq. 6, corrected)."""
    gamma = np.arctan2(v, u)
    # Printed with sine and cosine exchanged, which gives a length of about b.
    return p_0 * np.cos(gamma) - q * np.sin(gamma)


def solve_diagonal(
    data: StepDiagonal, readings_m: np.ndarray, linear_m: np.ndarray, *, form: Form
) -> np.ndarray:
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
        raise InputError(
            f"form {form}",
            "the source gives its equations in 2D only",
            "use the exact form for body diagonals",
        )
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


JACOBIAN_STEP_M = 1e-7
EQUAL_RELATIVE = 1e-12
"""Readings closer than this are equal."""


def laser_directions(data: StepDiagonal) -> np.ndarray:
    """Return the nominal laser directions (eq. 2), (K, D): +-step_j over the diagonal."""
    steps = np.array(data.steps_m)
    return data.signs * steps / np.linalg.norm(steps)


EQUAL_READINGS = (
    "the readings of all axes are equal in every block: either the linear errors of "
    "the axes are the same, or the mirror is parallel to the other diagonal and they "
    "hold only the length of the diagonal"
)


def readings_are_equal(data: StepDiagonal) -> bool:
    """Return whether all axes read the same in each of two or more blocks, with equal steps.

    This happens with a mirror parallel to the other diagonal, when the measurement gives
    only diagonal lengths (source, "Misalignment of mirror directions"), and with axes of the same
    linear errors (source, Table 1 b).
    """
    r = data.readings_m
    block_is_equal = np.ptp(r, axis=1) <= EQUAL_RELATIVE * np.abs(r).max()
    return bool(
        data.n_blocks > 1 and np.ptp(data.steps_m) == 0 and block_is_equal.all()
    )


def block_gain(data: StepDiagonal) -> np.ndarray:
    """Return the matrix from the readings of an axis in a block to its step, (D, n, D, K).

    Eq. 1 separates into one small system per axis: 2D two readings for two components, 3D
    four for three, by least squares weighted by the repeats.
    """
    directions = data.signs[:, :, None] * laser_directions(data)[:, None, :]
    weights = np.sqrt(data.counts).transpose(1, 2, 0)
    weighted = directions.transpose(1, 0, 2)[:, None] * weights[..., None]
    return np.linalg.pinv(weighted) * weights[:, :, None, :]


def solve_blocks(
    data: StepDiagonal, readings_m: np.ndarray, gain: np.ndarray
) -> np.ndarray:
    """Return the errors (D, n, D) from eq. 1 block by block, rotated to the first X step."""
    # The printed matrix has the rows of R_y,pp and R_y,np exchanged.
    vectors = np.einsum("jick,kji->jic", gain, readings_m)
    return turn_to_first_step(vectors) - step_vectors(
        data.steps_m, np.zeros_like(vectors)
    )


@one_thread()
def identify_wang(data: StepDiagonal) -> StepDiagonalResult:
    """Identify all errors from the readings alone, assuming the nominal laser directions.

    Parameters
    ----------
    data : StepDiagonal
        All diagonals; linear errors are not used.

    Returns
    -------
    StepDiagonalResult
        ``closure`` has the least squares' residual in 3D; in 2D there is no redundancy.

    Raises
    ------
    InputError
        If a diagonal is missing.
    """
    if len(data.diagonals) < 2 ** (data.dim - 1):
        raise InputError(
            "diagonals",
            f"only {', '.join(data.diagonals)} measured",
            "the conventional formulation needs every diagonal; measure the others",
        )
    readings = data.readings_m
    gain = block_gain(data)
    errors = solve_blocks(data, readings, gain)
    covariance = None
    noise = reading_noise(data)
    if noise.dof:
        jac = jacobian(lambda r: solve_blocks(data, r, gain), readings)
        covariance = jac @ reading_covariance(data, noise) @ jac.T
    return StepDiagonalResult(
        steps_m=data.steps_m,
        errors_m=errors,
        covariance=covariance,
        method=Method.CONVENTIONAL,
        form=Form.PRINTED,
        mirror_rad={},
        closure=Closure(residual_rms_m=_residual(data, readings)),
    )


def _residual(data: StepDiagonal, readings_m: np.ndarray) -> float | None:
    if data.dim == 2:
        return None
    directions = data.signs[:, :, None] * laser_directions(data)[:, None, :]
    misfit = [
        readings_m[:, j]
        - directions[:, j]
        @ np.linalg.lstsq(directions[:, j], readings_m[:, j], rcond=None)[0]
        for j in range(data.dim)
    ]
    return rms(np.array(misfit))


def jacobian(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return d function / d x by central differences, (outputs, inputs) in C order.

    The formulations are linear except for terms of (error / step)^2, so the differences are
    far more accurate than an uncertainty needs.
    """
    columns = []
    for index in range(x.size):
        shift = np.zeros(x.size)
        shift[index] = JACOBIAN_STEP_M
        up, down = (function(x + sign * shift.reshape(x.shape)) for sign in (1, -1))
        columns.append((up - down).ravel() / (2 * JACOBIAN_STEP_M))
    return np.array(columns).T


@one_thread()
def identify_ibaraki(
    data: StepDiagonal, *, form: Form = Form.EXACT
) -> StepDiagonalResult:
    """Identify the transverse errors from the readings and the measured linear errors.

    Parameters
    ----------
    data : StepDiagonal
        At least one diagonal in 2D, with linear errors.
    form : Form
        ``exact`` is valid for any constant mirror tilt; the other forms follow the paper's
        equations, 2D only, and take the mean of the diagonals.

    Raises
    ------
    InputError
        If the linear errors are missing, or do not fit the diagonals.
    NotIdentifiableError
        If the diagonals do not determine the errors.
    """
    check_lengths(data)
    lengths = length_closure(data) or (None, None)
    if form is not Form.EXACT:
        return _paper(data, form, lengths)
    adjusted = adjust(data)
    mirror = {
        name: np.arctan(tilt).tolist()
        for name, tilt in zip(data.diagonals, adjusted.tilt, strict=True)
    }
    between, u_between = None, None
    residual, u_residual, contradiction = None, None, ""
    if len(data.diagonals) > 1:
        residual = rms(adjusted.residuals_m)
        by_noise = residuals_by_noise(data, adjusted)
        if by_noise:
            u_residual = by_noise[0]
            contradiction = _contradiction(data, residual, by_noise)
        if data.dim == 2:
            by_diagonal = [adjust(data.pick([name])) for name in data.diagonals]
            between, u_between = between_diagonals(data, by_diagonal)
    return StepDiagonalResult(
        steps_m=data.steps_m,
        errors_m=adjusted.errors_m,
        covariance=propagated(data, adjusted.by_readings, adjusted.by_linear),
        method=Method.NEW,
        form=form,
        mirror_rad=mirror,
        closure=Closure(
            lengths_m=lengths[0],
            u_lengths_m=lengths[1],
            between_m=between,
            u_between_m=u_between,
            residual_rms_m=residual,
            u_residual_rms_m=u_residual,
            contradiction=contradiction,
        ),
    )


def _contradiction(
    data: StepDiagonal, residual_m: float, by_noise: tuple[float, float]
) -> str:
    """Return what residuals that noise does not explain say; empty where it explains them."""
    expected_m, probability = by_noise
    if probability > CONTRADICTION:
        return ""
    contradiction = (
        f"the readings of the diagonals contradict each other by "
        f"{residual_m * UM_PER_M:.3g} µm rms, where their repeats allow "
        f"{expected_m * UM_PER_M:.3g} µm; errors are beyond their u: "
    )
    samples = data.samples_m.copy()
    samples[:, data.signs < 0] = samples[:, data.signs < 0][:, :, ::-1]
    reversed_data = replace(data, samples_m=samples)
    otherwise = residuals_by_noise(reversed_data, adjust(reversed_data))
    if otherwise and otherwise[1] > CONTRADICTION:
        return (
            contradiction
            + "in the other order the blocks of the axes that run backwards (rx_np) agree; "
            "a block is a position on the axis, not a time"
        )
    return (
        contradiction
        + "the machine or the set-up changed between the runs, the mirror turned "
        "with the axes, or blocks are not in the order of their positions"
    )


def _paper(
    data: StepDiagonal, form: Form, lengths: tuple[float | None, float | None]
) -> StepDiagonalResult:
    """Return the mean of the diagonals by the paper's own equations."""

    def solve(readings: np.ndarray, linear: np.ndarray) -> np.ndarray:
        return solve_diagonal(data, readings, linear, form=form)

    readings, linear = data.readings_m, data.linear_mean_m
    by_diagonal = solve(readings, linear)
    by_readings = jacobian(lambda r: solve(r, linear).mean(axis=0), readings)
    by_linear = jacobian(lambda e: solve(readings, e).mean(axis=0), linear)
    between = by_diagonal[0] - by_diagonal[1] if len(by_diagonal) == 2 else None
    return StepDiagonalResult(
        steps_m=data.steps_m,
        errors_m=by_diagonal.mean(axis=0),
        covariance=propagated(data, by_readings, by_linear),
        method=Method.NEW,
        form=form,
        mirror_rad={},
        closure=Closure(*lengths, between),
    )


@dataclass(frozen=True)
class Choice:
    """Options of the identification.

    Attributes
    ----------
    method : Method
        Formulation.
    form : Form
        Form of the new formulation.
    allow_equal : bool
        Whether the new formulation accepts readings that are equal on all axes; the
        conventional one, a closed formula, always does.
    """

    method: Method
    form: Form = Form.EXACT
    allow_equal: bool = False


def identify(data: StepDiagonal, choice: Choice) -> StepDiagonalResult:
    """Identify the errors of a step-diagonal measurement by the chosen formulation.

    Raises
    ------
    InputError
        If the measurement lacks data for the formulation, or gives only diagonal lengths.
    NotIdentifiableError
        If the diagonals do not determine the errors.
    """
    if choice.method is Method.CONVENTIONAL:
        if choice.form is not Form.EXACT:
            raise InputError(
                "--form",
                "the conventional formulation has one form only",
                "leave it out, or use --method new",
            )
        return identify_wang(data)
    if readings_are_equal(data) and not choice.allow_equal:
        raise InputError(
            "readings",
            EQUAL_READINGS,
            "turn the mirror square to the laser, or allow equal readings if the "
            "linear errors truly are the same",
        )
    return identify_ibaraki(data, form=choice.form)
