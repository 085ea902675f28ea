# SPDX-License-Identifier: Apache-2.0
"""The result of a step-diagonal measurement as JSON (mm), as text and as figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.laser import profiles
from selfcal_ros.laser.data import AXES, Closure, Method, StepDiagonal, StepDiagonalResult
from selfcal_ros.laser.noise import linear_noise, reading_noise
from selfcal_ros.laser.simulation import StepMachine
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.parts import Curve, chart, titled
from selfcal_ros.units import M_PER_MM, MM_PER_M, UM_PER_M, UM_PER_MM

SCHEMA = "selfcal.step_diagonal/1"
CONVENTION = {
    "error": "actual - nominal; ey_x is the error in Y of a step along X",
    "reading": "positive on every diagonal; np: rx = -l.dx, ry = +l.dy",
    "datum": "turned so that the first X step has no transverse error",
    "squareness": "(slope of the X error over y + slope of the Y error over x) times the Y range; "
    "positive: the angle between +X and +Y is less than 90 deg",
    "straightness": "peak to valley of the transverse profile about its line",
}


def outcome(
    found: StepDiagonalResult,
    data: StepDiagonal,
    *,
    line: profiles.ReferenceLine = profiles.ReferenceLine.LEAST_SQUARES,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the JSON form of a result, lengths in mm.

    Parameters
    ----------
    found, data : StepDiagonalResult, StepDiagonal
        Result and the measurement behind it.
    line : ReferenceLine
        Reference line of straightness and squareness.
    warnings : sequence of str
        Warnings for the reader.
    """
    kinds = [(j, c) for j in range(found.dim) for c in range(found.dim)]
    out: dict[str, Any] = {"schema": SCHEMA, "method": str(found.method)}
    if found.method == Method.NEW:
        out["form"] = str(found.form)
    out |= {
        "unit": "mm",
        "line": str(line),
        "n_blocks": found.n_blocks,
        "diagonals": list(data.diagonals),
        "n_repeats": int(data.counts.max()),
        **{f"step_{AXES[j]}": step / M_PER_MM for j, step in enumerate(found.steps_m)},
    }
    out |= {profiles.name_of(j, c): _mm(found.errors_m[j, :, c]) for j, c in kinds}
    u = found.u_errors_m
    if u is not None:
        out |= {f"u_{profiles.name_of(j, c)}": _mm(u[j, :, c]) for j, c in kinds}
    out |= geometry(found, line)
    out["profiles"] = {
        f"p{profiles.name_of(j, c)[1:]}": {
            "position": _mm(profiles.positions_m(found, j)),
            "error": _mm(profiles.profile_m(found, j, c)),
            "u": _mm_or_none(profiles.u_profile_m(found, j, c)),
        }
        for j, c in kinds
    }
    out["scale"] = {AXES[j]: profiles.slope(found, j, j, line) for j in range(found.dim)}
    if found.dim == 2:
        out["error_map_equivalent"] = vars(profiles.map_equivalent(found))
    out["mirror_rad"] = found.mirror_rad
    out["closure"] = _closure(found)
    readings, linear = reading_noise(data), linear_noise(data)
    out["noise"] = {
        "reading": readings.sigma_m / M_PER_MM,
        "reading_dof": readings.dof,
        "correlation": readings.correlation,
        "linear": linear.sigma_m / M_PER_MM,
        "linear_dof": linear.dof,
    }
    out["convention"] = CONVENTION
    out["warnings"] = [*warnings, *_advice(found)]
    return plain(out)


def _mm(values_m: np.ndarray) -> list:
    return (np.asarray(values_m) / M_PER_MM).tolist()


def _mm_or_none(values_m: np.ndarray | None) -> list | None:
    return None if values_m is None else _mm(values_m)


def _value(prefix: str, value: profiles.Value) -> dict[str, float | None]:
    return {
        prefix: value.value / M_PER_MM,
        f"u_{prefix}": None if value.u is None else value.u / M_PER_MM,
    }


def geometry(found: StepDiagonalResult, line: profiles.ReferenceLine) -> dict[str, Any]:
    """Return squareness and straightness, mm: in 3D one name per pair, and the short names."""
    out: dict[str, Any] = _value("squareness", profiles.squareness(found, line=line))
    out["squareness_rad"] = profiles.squareness_rad(found, line=line)
    for axis in range(2):
        out |= _value(
            f"straightness_{AXES[axis]}", profiles.straightness(found, axis, 1 - axis, line)
        )
    if found.dim == 2:
        return out
    for j, c in profiles.axis_pairs(found.dim):
        out |= _value(f"squareness_{AXES[j]}{AXES[c]}", profiles.squareness(found, j, c, line))
    for j in range(found.dim):
        for c in range(found.dim):
            if c != j:
                name = f"straightness_{AXES[j]}_in_{AXES[c]}"
                out |= _value(name, profiles.straightness(found, j, c, line))
    return out


def _closure(found: StepDiagonalResult) -> dict[str, Any]:
    closure = found.closure
    out: dict[str, Any] = {
        key: None if value is None else value / M_PER_MM
        for key, value in (
            ("lengths", closure.lengths_m),
            ("u_lengths", closure.u_lengths_m),
            ("residual_rms", closure.residual_rms_m),
        )
    }
    for prefix, values in (("", closure.between_m), ("u_", closure.u_between_m)):
        if values is not None:
            out[f"{prefix}ey_x_pp_minus_np"] = _mm(values[0, :, 1])
            out[f"{prefix}ex_y_pp_minus_np"] = _mm(values[1, :, 0])
    return out


CLOSURE_SHARE = 2e-6
"""Closure of the lengths, relative to the diagonal, for a misalignment of 2 mrad."""


def _advice(found: StepDiagonalResult) -> list[str]:
    out = []
    diagonal = found.n_blocks * float(np.linalg.norm(found.steps_m))
    lengths = found.closure.lengths_m
    if (
        found.method == Method.NEW
        and lengths is not None
        and abs(lengths) > CLOSURE_SHARE * diagonal
    ):
        out.append(
            f"the diagonals differ from those calculated from the linear errors by "
            f"{lengths * UM_PER_M:.3g} um: the laser is off the machine's diagonal, or "
            "the linear errors are of another state of the machine"
        )
    if found.covariance is not None and not found.covariance.any():
        out.append("all repeats are identical: an uncertainty of zero cannot be right")
    return out


def summary(result: dict[str, Any]) -> str:
    """Return the main results as text, in micrometres."""

    def in_um(value_mm: float, u_mm: float | None) -> str:
        u = "" if u_mm is None else f" (u = {u_mm * UM_PER_MM:.4f})"
        return f"{value_mm * UM_PER_MM:+.4f} µm{u}"

    names = [
        key
        for key in result
        if key.startswith(("squareness", "straightness")) and not key.endswith("_rad")
    ]
    if "squareness_xy" in names:
        names = [
            key for key in names if key not in ("squareness", "straightness_x", "straightness_y")
        ]
    lines = [
        f"{result['method']} formulation, {result['n_blocks']} blocks, "
        f"{len(result['diagonals'])} diagonals, {result['n_repeats']} repeat(s)"
    ]
    lines += [f"  {key:22s} {in_um(result[key], result.get(f'u_{key}'))}" for key in names]
    lengths, u = result["closure"]["lengths"], result["closure"]["u_lengths"]
    if lengths is not None:
        lines.append(f"  {'closure of lengths':22s} {in_um(lengths, u)}")
    return "\n".join(lines)


def coverage(data: StepDiagonal) -> float:
    """Return k for 95.45 % at the fewer degrees of freedom: of readings or of linear errors."""
    known = [noise.dof for noise in (reading_noise(data), linear_noise(data)) if noise.dof]
    return coverage_factor(min(known)) if known else float("nan")


def profiles_figure(found: StepDiagonalResult, data: StepDiagonal) -> Drawing:
    """Return every accumulated error over its axis, with its expanded uncertainty."""
    k = coverage(data)
    bars = "" if found.covariance is None else f"; bars: U, k = {k:.3g}"
    drawing = titled("profiles", f"Step diagonal, {found.method} formulation{bars}")
    drawing.width, drawing.height = 240.0 * found.dim, 40.0 + 190 * found.dim
    for j in range(found.dim):
        for c in range(found.dim):
            u = profiles.u_profile_m(found, j, c)
            kind = "linear" if j == c else "transverse"
            chart(
                drawing,
                (56 + 240 * c, 56 + 190 * j, 176, 110),
                [
                    Curve(
                        profiles.positions_m(found, j) * MM_PER_M,
                        profiles.profile_m(found, j, c) * UM_PER_M,
                        "c0",
                        dots=2.0,
                        U=None if u is None else k * u * UM_PER_M,
                    )
                ],
                title=f"P{AXES[c]}({AXES[j]}), {kind}, µm",
                labels=(f"{AXES[j].upper()} in mm", ""),
            )
    return drawing


def truth_of(machine: StepMachine) -> dict[str, Any]:
    """Return the result of a perfect identification of a machine, mm, in the datum of results."""
    truth = StepDiagonalResult(machine.steps_m, machine.truth_m(), None, "", "", {}, Closure())
    errors = {
        profiles.name_of(j, c): (truth.errors_m[j, :, c] / M_PER_MM).tolist()
        for j in range(machine.dim)
        for c in range(machine.dim)
    }
    found = geometry(truth, profiles.ReferenceLine.LEAST_SQUARES)
    return {
        "unit": "mm",
        **errors,
        **{key: value for key, value in found.items() if not key.startswith("u_")},
    }
