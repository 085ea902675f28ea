# SPDX-License-Identifier: Apache-2.0
"""Data of a step-diagonal measurement: steps, diagonals, readings, and the identified errors.

Vectors of a block: axis j moves by d[j, i] = step_j e_j + E[j, i] in block i. On diagonal k the
axis runs with the sign s[k, j], so its reading is R[k, j, i] = s[k, j] w_k . d[j, i], with
w = n/(l . n) for the laser direction l and the mirror's normal n (method eq. 9.1). Nominal
readings are positive on every diagonal: in np, R_x = -l_np . dx.

A block is identified by its position on the axis, not by time: if an axis
runs backwards (X in np), its first step in time is that of the last block.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.units import MM_PER_M

AXES = "xyz"
DIAGONALS = {2: ("pp", "np"), 3: ("ppp", "npp", "pnp", "ppn")}
"""The diagonals of a 2D and of a 3D measurement; p: the axis runs forwards, n: backwards."""
MAX_BLOCKS = 500


class Method(StrEnum):
    """Formulation that computes errors from readings."""

    CONVENTIONAL = "conventional"
    NEW = "new"


class Form(StrEnum):
    """How the new formulation is evaluated.

    ``exact``: least squares over all diagonals of the exact geometry. ``stepwise``: the paper's
    eqs. 3, 4, 6 with the exact form in place of eq. 5. ``printed``: eqs. 3 to 6 as printed, with
    the errata of eqs. 4 and 6 corrected.
    """

    EXACT = "exact"
    STEPWISE = "stepwise"
    PRINTED = "printed"


def signs_of(diagonals: Sequence[str]) -> np.ndarray:
    """Return the running sense of every axis on every diagonal, +-1, (diagonals, axes)."""
    return np.array(
        [[-1.0 if letter == "n" else 1.0 for letter in name] for name in diagonals]
    )


@dataclass(frozen=True, eq=False)
class StepDiagonal:
    """Readings of a step-diagonal measurement, m.

    Attributes
    ----------
    steps_m : tuple of float (D,)
        Nominal steps a, b[, c] of the axes.
    diagonals : tuple of str (K,)
        Names of the measured diagonals, from `DIAGONALS`.
    samples_m : float array (repeats, K, D, n)
        Reading of axis j on diagonal k in block i; NaN for missing repeats of a block.
    linear_m : float array (repeats, D, n) or None
        Directly measured linear errors E_j(j), actual - nominal; NaN where not repeated.

    Raises
    ------
    InputError
        If a block has no reading.
    """

    steps_m: tuple[float, ...]
    diagonals: tuple[str, ...]
    samples_m: np.ndarray
    linear_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Refuse blocks without readings."""
        if not np.isfinite(self.samples_m).any(axis=0).all():
            raise InputError(
                "readings", "a block has no reading", "measure every block"
            )
        if (
            self.linear_m is not None
            and not np.isfinite(self.linear_m).any(axis=0).all()
        ):
            raise InputError(
                "linear errors", "a block has no value", "measure every block"
            )

    @property
    def dim(self) -> int:
        """Number of axes D, 2 or 3."""
        return len(self.steps_m)

    @property
    def n_blocks(self) -> int:
        """Number of blocks n."""
        return self.samples_m.shape[3]

    @property
    def signs(self) -> np.ndarray:
        """Running sense of the axes, (K, D)."""
        return signs_of(self.diagonals)

    @property
    def counts(self) -> np.ndarray:
        """Repeats behind each mean reading, int (K, D, n)."""
        return np.isfinite(self.samples_m).sum(axis=0)

    @property
    def readings_m(self) -> np.ndarray:
        """Mean readings, (K, D, n)."""
        return np.nanmean(self.samples_m, axis=0)

    @property
    def linear_mean_m(self) -> np.ndarray:
        """Mean linear errors, (D, n).

        Raises
        ------
        InputError
            If they were not measured.
        """
        if self.linear_m is None:
            raise InputError(
                "linear errors",
                "the new formulation needs them",
                "measure them directly along the axes, or use the conventional formulation",
            )
        return np.nanmean(self.linear_m, axis=0)

    def pick(self, diagonals: Sequence[str]) -> "StepDiagonal":
        """Return the same measurement with only some of its diagonals.

        Raises
        ------
        InputError
            If one of them was not measured.
        """
        for name in diagonals:
            if name not in self.diagonals:
                raise InputError(
                    "diagonals",
                    f"{name} was not measured, only " + ", ".join(self.diagonals),
                    "choose one of these",
                )
        index = [self.diagonals.index(name) for name in diagonals]
        return StepDiagonal(
            self.steps_m, tuple(diagonals), self.samples_m[:, index], self.linear_m
        )


@dataclass(frozen=True, eq=False)
class Closure:
    """Consistency of a redundant measurement, m.

    Attributes
    ----------
    lengths_m, u_lengths_m : float or None
        rms of the measured diagonals minus the value from the linear errors: zero for any
        squareness (parallelogram law); shows a misaligned laser or linear errors of another
        state. None without linear errors or with a missing diagonal.
    between_m, u_between_m : float array (D, n, D) or None
        2D, new formulation: errors from pp alone minus those from np alone.
    residual_rms_m, u_residual_rms_m : float or None
        rms residual of the least squares, and what the noise alone leaves; None without redundancy.
    contradiction : str
        What residuals beyond the noise say; empty where there are none.
    """

    lengths_m: float | None = None
    u_lengths_m: float | None = None
    between_m: np.ndarray | None = None
    u_between_m: np.ndarray | None = None
    residual_rms_m: float | None = None
    u_residual_rms_m: float | None = None
    contradiction: str = ""


@dataclass(frozen=True, eq=False)
class StepDiagonalResult:
    """Errors of every block, rotated so that the first X step has no transverse error.

    Attributes
    ----------
    steps_m : tuple of float (D,)
        Nominal steps.
    errors_m : float array (D, n, D)
        E[j, i, c]: error in direction c of the i-th step of axis j, actual - nominal, m. In 3D
        the first Y step has no Z error either.
    covariance : float array (D*n*D, D*n*D) or None
        Covariance of the errors in C order, m^2; None if the noise is unknown.
    method, form : str
        Formulation and form.
    mirror_rad : dict
        Diagonal -> angles between mirror normal and diagonal (2D: one, counter-clockwise),
        if the form determines them.
    closure : Closure
        Redundancy.
    """

    steps_m: tuple[float, ...]
    errors_m: np.ndarray
    covariance: np.ndarray | None
    method: str
    form: str
    mirror_rad: dict[str, list[float]]
    closure: Closure

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.steps_m)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return self.errors_m.shape[1]

    @property
    def u_errors_m(self) -> np.ndarray | None:
        """Standard uncertainties of the errors, (D, n, D), m; None if unknown."""
        if self.covariance is None:
            return None
        variance = np.maximum(np.diag(self.covariance), 0.0)
        return np.sqrt(variance).reshape(self.errors_m.shape)


def step_vectors(
    steps_m: Sequence[float] | np.ndarray, errors_m: np.ndarray
) -> np.ndarray:
    """Return the displacement vectors d = step e + E, (D, n, D), m."""
    return errors_m + np.diag(steps_m)[:, None, :]


def turn_to_first_step(vectors_m: np.ndarray) -> np.ndarray:
    """Return displacement vectors rotated so that the first X step is along X.

    In 3D the first Y step is then in the XY plane. Measurements along diagonals of unknown
    direction do not determine a rotation of the whole machine: this is the datum.

    Parameters
    ----------
    vectors_m : float array (D, n, D)
        d[j, i].
    """
    dim = len(vectors_m)
    # QR of the first block's steps, signs chosen so that the diagonal of R is positive.
    q, r = np.linalg.qr(vectors_m[:, 0].T)
    q = q * np.sign(np.diag(r))
    turned = vectors_m @ q
    for j in range(dim):
        turned[j, 0, j + 1 :] = 0.0
    return turned


NEAR = 1.25
"""Largest ratio of a reading to its nominal value, or the inverse."""
LINEAR_SHARE = 0.05
"""Largest linear error as a share of the step."""
_UNITS = {1e-3: "metres", 1e3: "micrometres", 1e6: "nanometres", 1 / 25.4: "inches"}


def is_near(ratio: float) -> bool:
    """Return whether a reading is about its nominal value."""
    return 1 / NEAR < ratio < NEAR


def check_reading(value_m: float, nominal_m: float, where: str) -> None:
    """Refuse a reading that is impossible with these steps.

    Parameters
    ----------
    value_m, nominal_m : float
        Reading, and its value without any error.
    where : str
        File, line and column.

    Raises
    ------
    InputError
        If it is not finite, negative, zero, or far from nominal; the message names a unit that
        explains the ratio.
    """
    if not math.isfinite(value_m):
        raise InputError(
            where, "not a finite number", "measure the block again or correct the cell"
        )
    ratio = value_m / nominal_m
    values_text = (
        f"{value_m * MM_PER_M:.6g} where {nominal_m * MM_PER_M:.6g} mm is nominal"
    )
    if is_near(ratio):
        return
    if is_near(-ratio):
        raise InputError(
            where,
            f"{values_text}: the sign is wrong",
            "readings are positive on every diagonal (np: R_x = -l . dx)",
        )
    for factor, unit in _UNITS.items():
        if is_near(ratio / factor):
            raise InputError(
                where, f"{values_text}: it looks like {unit}", "give millimetres"
            )
    raise InputError(where, values_text, "check the unit and --step-x, --step-y")


def check_linear(value_m: float, step_m: float, where: str) -> None:
    """Refuse a linear error that is not small compared with its step.

    Raises
    ------
    InputError
        If it is not finite or larger than `LINEAR_SHARE` of the step.
    """
    if not math.isfinite(value_m):
        raise InputError(
            where, "not a finite number", "measure the block again or correct the cell"
        )
    if abs(value_m) > LINEAR_SHARE * step_m:
        if is_near((value_m + step_m) / step_m) or not is_near(value_m / step_m):
            hint = "it looks like micrometres; give millimetres"
        else:
            hint = "it looks like the step itself; give measured step - nominal step"
        raise InputError(
            where,
            f"a linear error of {value_m * MM_PER_M:.6g} mm in a step of {step_m * MM_PER_M:g} mm",
            hint,
        )
