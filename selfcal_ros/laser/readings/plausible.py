# SPDX-License-Identifier: Apache-2.0
"""Numbers that cannot be what their column says: wrong unit, wrong sign, wrong step."""

import math

from selfcal_ros.errors import InputError
from selfcal_ros.units import MM_PER_M

NEAR = 1.25
"""Largest ratio of a reading to its nominal value, either way."""
LINEAR_SHARE = 0.05
"""Largest linear error as a share of the step."""
_UNITS = {1e-3: "metres", 1e3: "micrometres", 1e6: "nanometres", 1 / 25.4: "inches"}


def _is_near(ratio: float) -> bool:
    return 1 / NEAR < ratio < NEAR


def check_reading(value_m: float, nominal_m: float, where: str) -> None:
    """Refuse a reading that no machine with these steps can give.

    Parameters
    ----------
    value_m, nominal_m : float
        Reading, and what it is without any error.
    where : str
        File, line and column.

    Raises
    ------
    InputError
        If it is not finite, negative, zero, or far from nominal; a unit that explains the ratio is
        named.
    """
    if not math.isfinite(value_m):
        raise InputError(where, "not a finite number",
                         "measure the block again or correct the cell")
    ratio = value_m / nominal_m
    shown = f"{value_m * MM_PER_M:.6g} where {nominal_m * MM_PER_M:.6g} mm is nominal"
    if _is_near(ratio):
        return
    if _is_near(-ratio):
        raise InputError(where, f"{shown}: the sign is wrong",
                         "readings are positive on every diagonal (np: R_x = -l . dx)")
    for factor, unit in _UNITS.items():
        if _is_near(ratio / factor):
            raise InputError(where, f"{shown}: it looks like {unit}", "give millimetres")
    raise InputError(where, shown, "check the unit and --step-x, --step-y")


def check_linear(value_m: float, step_m: float, where: str) -> None:
    """Refuse a linear error that is not small beside its step.

    Raises
    ------
    InputError
        If it is not finite or larger than `LINEAR_SHARE` of the step.
    """
    if not math.isfinite(value_m):
        raise InputError(where, "not a finite number",
                         "measure the block again or correct the cell")
    if abs(value_m) > LINEAR_SHARE * step_m:
        if _is_near((value_m + step_m) / step_m) or not _is_near(value_m / step_m):
            hint = "it looks like micrometres; give millimetres"
        else:
            hint = "it looks like the step itself; give measured step - nominal step"
        raise InputError(where, f"a linear error of {value_m * MM_PER_M:.6g} mm in a step of "
                         f"{step_m * MM_PER_M:g} mm", hint)
