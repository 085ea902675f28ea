# SPDX-License-Identifier: Apache-2.0
"""The result of a step-diagonal measurement as JSON (mm), as text and as figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.applications.laser import profiles
from selfcal_ros.applications.laser.data import (
    AXES,
    Closure,
    Method,
    StepDiagonal,
    StepDiagonalResult,
)
from selfcal_ros.applications.laser.noise import linear_noise, reading_noise
from selfcal_ros.applications.laser.simulation import StepMachine
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.parts import Curve, chart, titled
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.units import (
    M_PER_MM,
    MM_PER_M,
    MRAD_PER_RAD,
    UM_PER_M,
    UM_PER_MM,
)

SCHEMA = "selfcal.step_diagonal/1"
CONVENTION = {
    "error": "actual - nominal; ey_x is the error in Y of a step along X",
    "reading": "positive on every diagonal; np: rx = -l.dx, ry = +l.dy",
    "datum": "turned so that the first X step has no transverse error",
    "squareness": "(slope of the X error over y + slope of the Y error over x) times the Y range; "
    "positive: the angle between +X and +Y is less than 90°",
    "straightness": "peak to valley of the transverse profile about its line",
}


def outcome(
    result: StepDiagonalResult,
    data: StepDiagonal,
    *,
    line: profiles.ReferenceLine = profiles.ReferenceLine.LEAST_SQUARES,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the JSON form of a result, lengths in mm.

    Parameters
    ----------
    result, data : StepDiagonalResult, StepDiagonal
        Result and the measurement behind it.
    line : ReferenceLine
        Reference line of straightness and squareness.
    warnings : sequence of str
        Warnings for the reader.
    """
    kinds = [(j, c) for j in range(result.dim) for c in range(result.dim)]
    out: dict[str, Any] = {"schema": SCHEMA, "method": str(result.method)}
    if result.method == Method.NEW:
        out["form"] = str(result.form)
    out |= {
        "unit": "mm",
        "line": str(line),
        "n_blocks": result.n_blocks,
        "diagonals": list(data.diagonals),
        "n_repeats": int(data.counts.max()),
        **{f"step_{AXES[j]}": step / M_PER_MM for j, step in enumerate(result.steps_m)},
    }
    out |= {profiles.name_of(j, c): _mm(result.errors_m[j, :, c]) for j, c in kinds}
    u = result.u_errors_m
    if u is not None:
        out |= {
            f"u_{profiles.name_of(j, c)}": _mm(u[j, :, c])
            if profiles.has_u(result, j, c)
            else None
            for j, c in kinds
        }
    out |= geometry(result, line)
    out["profiles"] = {
        f"p{profiles.name_of(j, c)[1:]}": {
            "position": _mm(profiles.positions_m(result, j)),
            "error": _mm(profiles.profile_m(result, j, c)),
            "u": _mm_or_none(profiles.u_profile_m(result, j, c)),
        }
        for j, c in kinds
    }
    out["scale"] = {
        AXES[j]: profiles.slope(result, j, j, line) for j in range(result.dim)
    }
    if result.dim == 2:
        out["error_map_equivalent"] = vars(profiles.map_equivalent(result))
    out["mirror_rad"] = result.mirror_rad
    out["closure"] = _closure(result)
    readings, linear = reading_noise(data), linear_noise(data)
    out["noise"] = {
        "reading": readings.sigma_m / M_PER_MM,
        "reading_dof": readings.dof,
        "correlation": readings.correlation,
        "run": readings.run_m / M_PER_MM,
        "run_dof": readings.run_dof,
        "linear": linear.sigma_m / M_PER_MM,
        "linear_dof": linear.dof,
        "linear_run": linear.run_m / M_PER_MM,
        "linear_run_dof": linear.run_dof,
    }
    out["convention"] = CONVENTION
    out["warnings"] = [*warnings, *_advice(result)]
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


def geometry(
    result: StepDiagonalResult, line: profiles.ReferenceLine
) -> dict[str, Any]:
    """Return squareness and straightness, mm: in 3D one name per pair, and the short names."""
    out: dict[str, Any] = _value("squareness", profiles.squareness(result, line=line))
    out["squareness_rad"] = profiles.squareness_rad(result, line=line)
    for axis in range(2):
        out |= _value(
            f"straightness_{AXES[axis]}",
            profiles.straightness(result, axis, 1 - axis, line),
        )
    if result.dim == 2:
        return out
    for j, c in profiles.axis_pairs(result.dim):
        out |= _value(
            f"squareness_{AXES[j]}{AXES[c]}", profiles.squareness(result, j, c, line)
        )
    for j in range(result.dim):
        for c in range(result.dim):
            if c != j:
                name = f"straightness_{AXES[j]}_in_{AXES[c]}"
                out |= _value(name, profiles.straightness(result, j, c, line))
    return out


def _closure(result: StepDiagonalResult) -> dict[str, Any]:
    closure = result.closure
    out: dict[str, Any] = {
        key: None if value is None else value / M_PER_MM
        for key, value in (
            ("lengths", closure.lengths_m),
            ("u_lengths", closure.u_lengths_m),
            ("residual_rms", closure.residual_rms_m),
            ("u_residual_rms", closure.u_residual_rms_m),
        )
    }
    for prefix, values in (("", closure.between_m), ("u_", closure.u_between_m)):
        if values is not None:
            out[f"{prefix}ey_x_pp_minus_np"] = _mm(values[0, :, 1])
            out[f"{prefix}ex_y_pp_minus_np"] = _mm(values[1, :, 0])
    return out


CLOSURE_SHARE = 2e-6
"""Closure of the lengths, relative to the diagonal, for a misalignment of 2 mrad."""


def _advice(result: StepDiagonalResult) -> list[str]:
    out = []
    diagonal = result.n_blocks * float(np.linalg.norm(result.steps_m))
    lengths = result.closure.lengths_m
    if (
        result.method == Method.NEW
        and lengths is not None
        and abs(lengths) > CLOSURE_SHARE * diagonal
    ):
        out.append(
            f"the diagonals differ from those calculated from the linear errors by "
            f"{lengths * UM_PER_M:.3g} µm: the laser is off the machine's diagonal, or "
            "the linear errors are of another state of the machine"
        )
    if result.closure.contradiction:
        out.append(result.closure.contradiction)
    out += _set_up(result)
    if result.covariance is not None and not result.covariance.any():
        out.append("all repeats are identical: an uncertainty of zero cannot be right")
    return out


LASER_OFF_RAD = 1e-4
"""A laser is not known to be nearer to the machine's diagonal: 10 um of its spot over 100 mm."""


def _set_up(result: StepDiagonalResult) -> list[str]:
    """Return what u leaves out: the mirror's angle, by formulation."""
    x, y = (result.n_blocks * step for step in result.steps_m[:2])
    diagonal = result.n_blocks * float(np.linalg.norm(result.steps_m))
    if result.method == Method.CONVENTIONAL:
        square_m = 1e-3**2 / 2 * diagonal**2 / (2 * x)
        wrong = (
            f"1 mrad on one diagonal adds {1e-3 * y / 2 * UM_PER_M:.3g} µm to Px(x) and "
            f"{square_m * UM_PER_M:.2g} µm to the squareness, whose u does not contain it"
            if result.dim == 2
            else "squareness as well"
        )
        return [
            "the linear errors, which have no u, hold only if the mirror is square to the laser: "
            f"{wrong}; measure them along the axes, and use --method new"
        ]
    angles = np.array(list(result.mirror_rad.values()))
    if not angles.size or result.covariance is None:
        return []
    share = diagonal**2 / (x * len(angles))
    off_m = LASER_OFF_RAD * float(np.linalg.norm(angles)) * share
    u_m = profiles.squareness(result).u
    if u_m is None or off_m <= u_m:
        return []
    return [
        f"the mirror is off the laser by up to {np.abs(angles).max() * MRAD_PER_RAD:.3g} mrad: "
        f"where the laser is {LASER_OFF_RAD * MRAD_PER_RAD:g} mrad off the machine's diagonal, "
        f"squareness errs by {off_m * UM_PER_M:.2g} µm, which u does not contain; turn the "
        "mirror square to the laser"
    ]


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
            key
            for key in names
            if key not in ("squareness", "straightness_x", "straightness_y")
        ]
    lines = [
        f"{result['method']} formulation, "
        f"{counted(result['n_blocks'], 'block')}, {counted(len(result['diagonals']), 'diagonal')}, "
        f"{counted(result['n_repeats'], 'repeat')}"
    ]
    lines += [
        f"  {key:22s} {in_um(result[key], result.get(f'u_{key}'))}" for key in names
    ]
    lengths, u = result["closure"]["lengths"], result["closure"]["u_lengths"]
    if lengths is not None:
        lines.append(f"  {'closure of lengths':22s} {in_um(lengths, u)}")
    return "\n".join(lines)


def coverage(data: StepDiagonal) -> float:
    """Return k for 95.45 % at the fewer degrees of freedom: of readings or of linear errors."""
    dofs = [
        noise.dof for noise in (reading_noise(data), linear_noise(data)) if noise.dof
    ]
    return coverage_factor(min(dofs)) if dofs else float("nan")


def profiles_figure(result: StepDiagonalResult, data: StepDiagonal) -> Drawing:
    """Return every accumulated error over its axis, with its expanded uncertainty."""
    k = coverage(data)
    bars = "" if result.covariance is None else f"; bars: U, k = {k:.3g}"
    drawing = titled("profiles", f"Step diagonal, {result.method} formulation{bars}")
    drawing.width, drawing.height = 240.0 * result.dim, 40.0 + 190 * result.dim
    for j in range(result.dim):
        for c in range(result.dim):
            u = profiles.u_profile_m(result, j, c)
            kind = "linear" if j == c else "transverse"
            chart(
                drawing,
                (56 + 240 * c, 56 + 190 * j, 176, 110),
                [
                    Curve(
                        profiles.positions_m(result, j) * MM_PER_M,
                        profiles.profile_m(result, j, c) * UM_PER_M,
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
    truth = StepDiagonalResult(
        steps_m=machine.steps_m,
        errors_m=machine.truth_m(),
        covariance=None,
        method="",
        form="",
        mirror_rad={},
        closure=Closure(),
    )
    errors = {
        profiles.name_of(j, c): (truth.errors_m[j, :, c] / M_PER_MM).tolist()
        for j in range(machine.dim)
        for c in range(machine.dim)
    }
    truth_geometry = geometry(truth, profiles.ReferenceLine.LEAST_SQUARES)
    return {
        "unit": "mm",
        **errors,
        **{
            key: value
            for key, value in truth_geometry.items()
            if not key.startswith("u_")
        },
    }
