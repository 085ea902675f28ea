# SPDX-License-Identifier: Apache-2.0
"""Effect of set-up faults on both formulations of the step-diagonal measurement.

The table of docs/guides/step_diagonal.md: each fault simulated on the machine of the source's case
study.

    .venv/bin/python tools/sensitivity.py [--plot FILE]
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.applications.laser import simulation as measure
from selfcal_ros.applications.laser.data import (
    DIAGONALS,
    Closure,
    Method,
    StepDiagonal,
    StepDiagonalResult,
)
from selfcal_ros.applications.laser.identify import Choice, identify
from selfcal_ros.applications.laser.profiles import squareness, straightness
from selfcal_ros.reporting.figures.drawing import SERIES, Drawing
from selfcal_ros.reporting.figures.paper import save_picture
from selfcal_ros.reporting.figures.parts import Curve, chart, legend, titled
from selfcal_ros.units import UM_PER_M

PP, NP = DIAGONALS[2]
NOISE_DRAWS = 30
SEED = 1
Broken = tuple[measure.StepMachine, measure.Measurement]
DASHES: dict[str, tuple[float, ...]] = {"conventional": (5, 3), "new": ()}
NOTHING_UM = 1e-6
"""What stands for zero on a logarithmic scale."""
SWEEP = tuple(10.0 ** np.arange(-5, -1.9, 0.5))
"""Angles of a sweep, rad."""


@dataclass(frozen=True)
class Fault:
    """A fault, as a function of its size.

    Attributes
    ----------
    name : str
        Name of the fault.
    size : float
        Size in the table.
    unit : str
        Its unit.
    apply : callable
        (machine, size) -> the machine and the measurement with the fault.
    random : bool
        Whether it is random, so that the table shows the rms of draws.
    """

    name: str
    size: float
    unit: str
    apply: Callable[[measure.StepMachine, float], Broken]
    random: bool = False


@dataclass(frozen=True)
class Effect:
    """Errors of an identification, m.

    Attributes
    ----------
    linear_m : float
        Largest error of Ex(x) and Ey(y) of a block.
    transverse_m : float
        Largest error of Ey(x) and Ex(y) of a block.
    squareness_m, straightness_m : float
        Error of the squareness, and the larger one of the two straightnesses, over the range.
    """

    linear_m: float
    transverse_m: float
    squareness_m: float
    straightness_m: float


def _setup_fault(
    name: str, make: Callable[[float], tuple[measure.SetUp, measure.SetUp]]
) -> Fault:
    def apply(machine: measure.StepMachine, size: float) -> Broken:
        pp, other = make(size)
        return machine, measure.Measurement({PP: pp, NP: other})

    return Fault(name, 1e-3, "rad", apply)


def _yaw(
    axis: int, *, wavy: bool = False, abbe_m: float = 0.0, stacked: bool = False
) -> Callable:
    """Return a fault of an axis that turns by `size` in every block, or back and forth."""

    def apply(machine: measure.StepMachine, size: float) -> Broken:
        turns = np.zeros((machine.dim, machine.n_blocks, 3))
        turns[axis, :, 2] = size * (
            (-1.0) ** np.arange(machine.n_blocks) if wavy else 1.0
        )
        spot = measure.SetUp(abbe_m=(-abbe_m / np.sqrt(2), abbe_m / np.sqrt(2), 0.0))
        return (
            replace(machine, turns_rad=turns, stacked=stacked),
            measure.Measurement({PP: spot, NP: spot}),
        )

    return apply


def _noise(make: Callable[[float], measure.LaserNoise]) -> Callable:
    return lambda machine, size: (machine, measure.Measurement({}, make(size)))


FAULTS = (
    Fault(
        "none: laser along the machine's own diagonal",
        0.0,
        "",
        lambda machine, _: (machine, measure.Measurement()),
    ),
    Fault(
        "none: laser along the nominal diagonal",
        0.0,
        "",
        lambda machine, _: (
            machine,
            measure.Measurement(
                dict.fromkeys((PP, NP), measure.SetUp(to_machine=False))
            ),
        ),
    ),
    _setup_fault(
        "mirror off, pp", lambda s: (measure.SetUp(mirror_rad=(s,)), measure.SetUp())
    ),
    _setup_fault(
        "mirror off, pp and np equally", lambda s: (measure.SetUp(mirror_rad=(s,)),) * 2
    ),
    _setup_fault(
        "laser off, pp", lambda s: (measure.SetUp(laser_rad=(s,)), measure.SetUp())
    ),
    _setup_fault(
        "laser off, pp and np equally", lambda s: (measure.SetUp(laser_rad=(s,)),) * 2
    ),
    _setup_fault(
        "laser and mirror off, pp",
        lambda s: (measure.SetUp(laser_rad=(s,), mirror_rad=(s,)), measure.SetUp()),
    ),
    _setup_fault(
        "laser and mirror off, pp and np equally",
        lambda s: (measure.SetUp(laser_rad=(s,), mirror_rad=(s,)),) * 2,
    ),
    Fault("X turns steadily, per block", 1e-6, "rad", _yaw(0)),
    Fault("X turns back and forth, per block", 1e-6, "rad", _yaw(0, wavy=True)),
    Fault("Y turns steadily, per block", 1e-6, "rad", _yaw(1)),
    Fault("X turns and carries Y, per block", 1e-6, "rad", _yaw(0, stacked=True)),
    Fault(
        "X turns steadily, beam 10 mm off the point", 1e-6, "rad", _yaw(0, abbe_m=0.01)
    ),
    Fault(
        "unit of length of the laser, pp",
        1e-7,
        "relative",
        lambda machine, size: (
            machine,
            measure.Measurement({PP: measure.SetUp(scale=size)}),
        ),
    ),
    Fault(
        "noise of a laser distance, 3 repeats",
        10e-9,
        "m",
        _noise(lambda size: measure.LaserNoise(distance_m=size, repeats=3)),
        random=True,
    ),
    Fault(
        "noise of the linear measurement, 3 repeats",
        10e-9,
        "m",
        _noise(lambda size: measure.LaserNoise(linear_m=size, repeats=3)),
        random=True,
    ),
)


def effect(machine: measure.StepMachine, data: StepDiagonal, method: Method) -> Effect:
    """Return the errors of one identification relative to the truth."""
    found = identify(data, Choice(method, allow_equal=True))
    truth = StepDiagonalResult(
        machine.steps_m, machine.truth_m(), None, "", "", {}, Closure()
    )
    wrong = np.abs(found.errors_m - truth.errors_m)
    straight = [
        abs(
            straightness(found, axis, 1 - axis).value
            - straightness(truth, axis, 1 - axis).value
        )
        for axis in (0, 1)
    ]
    return Effect(
        float(max(wrong[0, :, 0].max(), wrong[1, :, 1].max())),
        float(max(wrong[0, :, 1].max(), wrong[1, :, 0].max())),
        abs(squareness(found).value - squareness(truth).value),
        max(straight),
    )


def effect_of(
    fault: Fault,
    size: float,
    machine: measure.StepMachine,
    *,
    method: Method,
    rng: np.random.Generator,
) -> Effect:
    """Return the effect of a fault of a given size; for a random one the rms over draws."""
    broken, measurement = fault.apply(machine, size)
    draws = [
        effect(broken, measure.simulate_step_diagonal(broken, measurement, rng), method)
        for _ in range(NOISE_DRAWS if fault.random else 1)
    ]
    table = np.array(
        [[d.linear_m, d.transverse_m, d.squareness_m, d.straightness_m] for d in draws]
    )
    return Effect(*np.sqrt(np.mean(table**2, axis=0)).tolist())


def sensitivity(machine: measure.StepMachine, rng: np.random.Generator) -> list[dict]:
    """Return one row per fault: its size and the effects on both formulations, m."""
    return [
        {
            "fault": fault.name,
            "size": fault.size,
            "unit": fault.unit,
            **{
                method: vars(found)
                for method, found in _both(fault, fault.size, machine, rng).items()
            },
        }
        for fault in FAULTS
    ]


def sweep(machine: measure.StepMachine, rng: np.random.Generator) -> list[dict]:
    """Return the effects of the faults of laser and mirror over angles, for a plot."""
    chosen = [fault for fault in FAULTS if fault.unit == "rad" and fault.size == 1e-3]
    return [
        {
            "fault": fault.name,
            "size": list(SWEEP),
            **_columns([_both(fault, size, machine, rng) for size in SWEEP]),
        }
        for fault in chosen
    ]


def _both(
    fault: Fault, size: float, machine: measure.StepMachine, rng: np.random.Generator
) -> dict[str, Effect]:
    """Return the effect on each formulation, from the same draws."""
    seed = int(rng.integers(2**63))
    return {
        str(method): effect_of(
            fault, size, machine, method=method, rng=np.random.default_rng(seed)
        )
        for method in Method
    }


def _columns(effects: list[dict[str, Effect]]) -> dict[str, list[dict]]:
    return {
        str(method): [vars(each[str(method)]) for each in effects] for method in Method
    }


def sensitivity_text(rows: list[dict]) -> str:
    """Return the table of effects in micrometres as text."""
    width = max(len(row["fault"]) for row in rows)
    head = f"{'fault':{width}s} {'size':>14s}"
    columns = ("linear_m", "transverse_m", "squareness_m", "straightness_m")
    names = ("linear", "transverse", "squareness", "straightness")
    lines = [
        f"{'':{width + 15}s} {'conventional, um':>51s} {'new, um':>51s}",
        head + " ".join(["", *(f"{name:>12s}" for name in names * 2)]),
    ]
    for row in rows:
        size = f"{row['size']:g} {row['unit']}" if row["unit"] else "-"
        values = [
            row[str(method)][column] * UM_PER_M
            for method in Method
            for column in columns
        ]
        lines.append(
            f"{row['fault']:{width}s} {size:>14s} "
            + " ".join(f"{value:12.4f}" for value in values)
        )
    return "\n".join(lines)


def sensitivity_figure(curves: list[dict]) -> Drawing:
    """Return the errors of both formulations over the size of laser and mirror angles.

    `curves` is what `sweep` gives.
    """
    drawing = titled(
        "sensitivity", "Errors in µm over the angle by which laser or mirror are off"
    )
    drawing.width = 900.0
    panels = (
        ("linear_m", "linear error of a block"),
        ("transverse_m", "transverse error of a block"),
        ("squareness_m", "squareness over the range"),
    )
    for number, (column, title) in enumerate(panels):
        chart(
            drawing,
            (50 + 295 * number, 56, 235, 240),
            [
                Curve(
                    np.array(curve["size"]),
                    np.maximum(
                        np.array([effect[column] for effect in curve[method]])
                        * UM_PER_M,
                        NOTHING_UM,
                    ),
                    f"c{place % SERIES}",
                    dash=dash,
                    dots=1.5,
                )
                for place, curve in enumerate(curves)
                for method, dash in DASHES.items()
            ],
            title=title,
            labels=("angle in rad", ""),
            log=True,
        )
    for place, curve in enumerate(curves):
        legend(
            drawing,
            [(f"c{place % SERIES}", curve["fault"])],
            (50 + 295 * (place % 3), 356 + 18 * (place // 3)),
        )
    bottom = 356.0 + 18 * -(-len(curves) // 3)
    drawing.label(
        50,
        bottom,
        "dashed: conventional formulation, solid: new; the lowest value stands for all below 1 pm",
        colour="soft",
    )
    drawing.height = bottom + 14
    return drawing


def main() -> int:
    """Print the table, and draw the curves if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--plot", metavar="FILE", help="draw the curves (png, svg or pdf)"
    )
    args = parser.parse_args()
    machine, rng = measure.case_study_machine(), np.random.default_rng(SEED)
    print(sensitivity_text(sensitivity(machine, rng)))
    if args.plot:
        save_picture(sensitivity_figure(sweep(machine, rng)), args.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
