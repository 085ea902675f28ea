# SPDX-License-Identifier: Apache-2.0
"""`make reference`: the page of that name from code that reads and writes what it describes."""

import json
import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from textwrap import wrap
from typing import Any

from yaml import safe_dump

from selfcal_ros.errors import InputError
from selfcal_ros.model.kept import KEYS
from selfcal_ros.model.parts import PARTS
from selfcal_ros.model.plan_form import plan_from_dict
from selfcal_ros.model.result import VERIFICATION, result_to_dict
from selfcal_ros.outputs import write_text
from selfcal_ros.settings.nodes import NODE_PARAMETERS
from selfcal_ros.settings.parameter import Parameter

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/reference/reference.md"
PARAMETERS = ROOT / "config/params/all.yaml"
PARAMETERS_HEAD = """# Every parameter of every node, at its default, SI units; by `make reference`.
# In brackets the unit, and what is allowed. A file of your own needs only what differs."""
HEAD = """# Reference

For looking up: keys of PLAN.yaml and RESULT.json; where parameters and messages are described. Keys
of SIM.yaml: [simulate.md](../guides/simulate.md). SI units. `make reference` writes this page.
"""
PLAN = {
    "plan_id": "name of the plan; a plan has one plate",
    "artifact": "the plate",
    "views": "list of views, in their order",
    "visit_order": "order of the marks in views without their own "
    "(docs/guides/identifiability.md); default: chosen by the cell",
    "model_terms": "list of TERM or TERM:SIZE to be estimated with the map; default: none",
    "verify": "RESULT.json whose correction is on while the plan is measured, relative to the plan "
    "(docs/guides/verify.md); `artifact` and `map` are then those of the result unless "
    "given; default: no correction is verified",
    "artifact_from": "RESULT.json of the calibration that made the plate known, relative to the "
    "plan (docs/guides/recheck.md); `artifact` and `map` are then those of the "
    "result unless given; default: the plate is not known",
    "microscope": "standard uncertainties of the microscope; default: the solver's "
    "parameters of these names",
    "microscope.scale_u": "of its scale, m/m; default 0.01",
    "microscope.rotation_u": "of its rotation relative to the axes, rad; default 0.01",
    "microscope.shear_u": "of half the difference of its scales, and of half its error of "
    "squareness, m/m; default 0.002",
    "check_stops": "marks of each grid view that are measured four more times, the stage "
    "deliberately off them (docs/start/cell.md); default: none",
    "check_stops.marks": "how many marks",
    "check_stops.offset": "distance of the stage from the mark, m; at most a quarter of the pitch",
    "map": "nodes of the error map where they are not the sites of the plate's lattice "
    "(docs/guides/identifiability.md); default: those sites, or for views off the lattice "
    "an odd number of nodes, at most three quarters of the marks, over the same field",
    "map.grid_size": "nodes along x, from 3",
    "map.grid_pitch": "distance between neighbouring nodes, m; default: the nodes span the plate",
    "map.interpolation": "between the nodes: bilinear or bicubic; default bicubic",
    "map.harmonics": "harmonics of the angular map, fewer than half the lines: a Fourier series, "
    "for lines at any turn; default: a value for each line",
    "map.grid_size_y": "nodes along y if the map is not square; default: as along x",
    "image": "marks that an image shows: detections of one stamp are one image "
    "(docs/reference/bags.md); default: one mark",
    "image.nx": "marks along stage x, odd; the middle one is on the optical axis",
    "image.ny": "marks along stage y, odd",
    "image.pitch_m": "distance between them, m, a whole number of pitches; default: the pitch",
    "artifact.grid_size": "N, marks along x, 3 to 401; or [along x, along y]",
    "artifact.grid_pitch": "distance between neighbouring marks, m",
    "artifact.angular_count": "K, angular lines, at least 3; 0 or omitted without lines",
    "artifact.grid_size_y": "marks along y if the plate is not square; default: N",
    "artifact.marks": "a table of the marks beside the plan, id,x,y, instead of a lattice: the "
    "other keys but angular_count are left out",
    "views[].name": "name, unique",
    "views[].rotation_deg": "nominal turn, counter-clockwise, degrees; default 0",
    "views[].translation_pitch": "[a, b], nominal shift along stage x and y in pitches; "
    "default [0, 0]",
    "views[].translation_mm": "the same in mm",
    "views[].grid": "whether grid marks are measured; default true",
    "views[].angular": "whether angular lines are measured; needs a turn by whole lines; default: "
    "true if the plate has some and the turn is such a turn",
    "views[].repeats": "number of times that every mark is measured; default 1",
    "views[].visit_order": "order of the grid marks in this view",
}
RESULT = {
    "schema": "`selfcal.result/1`",
    "plan_id": "plan that was measured",
    "method": "`joint` or `law`",
    "measurement_sense": "`microscope_moves` or `plate_moves`",
    "artifact": "the plate, as in PLAN.yaml; magnification, u_magnification: by how much the "
    "encoders indicate it larger than nominal, m/m",
    "run_id": "stamp of the run's first command, ns",
    "verdict": "`grade` (good, enlarged, not_qualified), `qualified` (false for not_qualified), "
    "`sentence`, `reasons`, `failed` (the tests that failed, as `findings`), "
    "`enlarged_by` (each name, u_rms, u_max, unit), and `causes`, most likely first: as "
    "`findings`, and effect_rms, effect_max, told (whether the readings determine it "
    "all), remedies (a list of {model}, {map}, {view} to measure again, {action})",
    "model": "`misalignment` (rigid, linear) and `terms`: name, size (null = free), estimates "
    "(view, component, value, u, unit), size_used (if the readings contradict the "
    "size), source (declared, default, readings)",
    "reference": "kind, relative_error, u_relative, certificate of a known length; null without; "
    "with `reference_at` `certified`: its numbers and temperatures; of the kind marks "
    "`marks`: their (m, n)",
    "provenance": "created (ISO 8601, UTC), duration_s, version, first_exposure, last_exposure, "
    "visit_order of each view",
    "dof": "degrees of freedom of the map's uncertainty at its nodes, Welch-Satterthwaite: xy, "
    "theta",
    "coverage_factor": "k for 95.45 % at those degrees of freedom: xy, theta",
    "views": "a list: name, rotation (rad), translation_x, translation_y (m), misalignment {phi "
    "(rad), tx, ty (m)}, used, rejected, read {grid, angular} (weights of the readings)",
    "error_map": "gx, gy, u_gx, u_gy: Nx×Ny lists in m, [i][j] at x = (i − (Nx−1)/2) pitches and "
    "y = (j − (Ny−1)/2) pitches, null where unknown; g_theta, u_g_theta: K numbers in rad; "
    "nonorthogonality, scale_difference, datum_theta",
    "artifact_map": "ax, ay, u_ax, u_ay (m), a_theta, u_a_theta (rad) of the plate, as error_map; "
    "u_a_theta with the θ datum zero_mean, no u of the plate by Hu's law",
    "observability": "rank, unknowns, deficiency, identifiable, modes, advice; unchecked_sites, "
    "unchecked_lines: number that depend on single readings, null if not counted",
    "noise": "sigma_* of one reading (m, rad): used, from repeats, from residuals, declared; "
    "dof_*; k_*; p_* of the F-test",
    "rejected": "reason -> number of detections",
    "warnings": "a list of sentences",
    "findings": "the data behind `warnings`: a list of name, text, view, axis, mark (m, n) or (k), "
    "size, u, unit, p, details (by name, SI units)",
    "digest": "key -> the first 64 bits of the SHA-256 of its value, without the time of creation: "
    "a key that was edited is refused by name, a file without `digest` too; one of a "
    "version before 0.4.0, which wrote none, is not qualified",
    "budget": "a line for each component of the uncertainty: quantity (xy in m, theta in rad), "
    "component, type (A, B), value, u, unit (of the input quantity), effect_rms, "
    "effect_max (on the map, k = 1), dof (null = many), source (readings, declared, "
    "default), details, text",
    "input": "file and sha256 of the bag",
    "covariance_terms": "terms and factors (r, 2, N, N), for the exact comparison of results; "
    "those of lack_of_fit, roughness and reversal add to variances alone, that of noise "
    "scales the others; "
    "up to 31 × 31 sites, and not with `--model none`; beside: what they make "
    "of the plate, (r, 2, N, N), of both angular maps, (r, 2, K), and of the "
    "microscope, (r, 4), the last two times the plate's longer half width; "
    "with_map: how many of them belong to the factors; terms: those of the others; "
    "effects_on_plate: what effects outside the model add to the variance of the plate's map, "
    "(2, nx, ny), over σ²",
    "angular_terms": "contribution of each term or cause to the uncertainty of the angular map, "
    "rad",
    "residuals": "views: view, dx, dy (m, [i][j] by mark, stage axes), dtheta (rad), course "
    "{time_s, dx, dy, count} over the view's time",
}
SOMETIMES = {
    "map": "nodes of the map where they are not the sites of the lattice, as in PLAN.yaml",
    "recheck": "what has changed since the calibration of the plate (docs/guides/recheck.md)",
    "verification": "what a correction did while it was on: of, sentence, better, passed, fault, "
    "theta_fault, remains, correlation, axes, remaining (docs/guides/verify.md)",
    "camera": "of images with several marks: scale, rotation, stretch, shear (each with u_), "
    "degree, coefficients, cells, noise_image, noise_mark (m), and yaw of the stage {x, y (m), "
    "yaw, u_yaw (rad), p}",
    "images": "of images with several marks: share of the variance of a reading that they have in "
    "common, dof_mark (null = many), and of each grid view placing and step (m, n) of its cell; "
    "motion {mark, white, slow} (null if none is slow): variances, over that of a reading, of a "
    "mark by itself and of white and slow motion that the marks of an image share",
    "first_order_added": "what unequal or correlated noise adds to the variances of O and of R, "
    "times the square of the half width, for unit noise",
    "combined": "`selfcal combine`: u_between_m, p_between (_rad, _theta) and `runs`: file, "
    "weight, e_n_rms, e_n_largest, beyond (share of |E_n| > 1), p, agrees, stands_out "
    "(_theta; agrees is null, and agrees_theta left out, where there is no noise to test it by), "
    "calibration (of a recheck: as in recheck)",
    "map_covariance": "covariance of a mean map or a recheck up to 21 × 21 sites, lower "
    "triangles over Gx, then Gy, of the known sites (`xy`) and over the known lines "
    "(`theta`), in units of scale_xy (m²), scale_theta (rad²)",
    "rejected_at": "positions of rejected grid detections: view, reason, x, y (m)",
    "turned": "views whose lines turned slowly while they were read in passes, which was taken out",
    "outliers": "`--robust`: rule, and the readings removed",
    "slips": "`--robust`: slips of the plate",
    "noisy_views": "`--robust`: views noisier than the others",
    "validation": "`--validate`: readings held out, and prediction errors",
}


def table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]] | list) -> list[str]:
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"
            for row in rows
        ),
    ]


def known_keys(data: dict, where: str = "p") -> list[str]:
    """Return the keys that the reader of plans names when it meets another."""
    try:
        plan_from_dict(data, where)
    except InputError as error:
        return error.remedy.partition("known are ")[2].split(", ")
    raise AssertionError("an unknown key was taken")


def plan_keys() -> list[str]:
    whole: dict[str, Any] = {
        "plan_id": "p",
        "artifact": {"grid_size": 3, "grid_pitch": 0.01, "angular_count": 0},
        "views": [{"name": "a"}],
    }
    strange = {"?": 1}
    return [
        *known_keys(whole | strange),
        *(
            f"{part}.{key}"
            for part in ("map", "image", "microscope", "check_stops")
            for key in known_keys(whole | {part: strange})
        ),
        *(
            f"artifact.{key}"
            for key in known_keys(whole | {"artifact": whole["artifact"] | strange})
        ),
        *(
            f"views[].{key}"
            for key in known_keys(whole | {"views": [{"name": "a"} | strange]})
        ),
    ]


def described(
    keys: list[str], words: dict[str, str], what: str
) -> list[tuple[str, str]]:
    missing = sorted(set(keys) ^ set(words))
    if missing:
        raise SystemExit(
            f"{what}: {', '.join(missing)}: described and not there, or the reverse"
        )
    return [(f"`{key}`", words[key]) for key in keys]


def bounds(p: Parameter) -> str:
    if p.choices:
        return " | ".join(map(str, p.choices))
    return "" if p.low is None or p.high is None else f"{p.low:g} to {p.high:g}"


def parameters_text() -> str:
    """Return the parameter file with everything that can be set, at its default."""
    lines = [PARAMETERS_HEAD]
    for node, parameters in NODE_PARAMETERS.items():
        lines += ["", f"{node}:", "  ros__parameters:"]
        for p in parameters:
            facts = "; ".join(filter(None, (p.unit, bounds(p))))
            about = f"{p.description} [{facts}]" if facts else p.description
            lines += [f"    # {line}" for line in wrap(about, 90)]
            number = isinstance(p.default, int | float) and not isinstance(
                p.default, bool
            )
            # ROS takes a bare y as true; 1e-09 is a number with a point alone
            default = (
                safe_dump(p.default).split()[0] if number else json.dumps(p.default)
            )
            lines.append(f"    {p.name}: {default}")
    return "\n".join(lines) + "\n"


def message_rows() -> Iterator[tuple[str, ...]]:
    """Yield each message, service and action with the first sentence of its definition."""
    for kind in ("msg", "srv", "action"):
        for path in sorted((ROOT / "msg_defs" / kind).iterdir()):
            about = takewhile(
                lambda line: line.startswith("#"), path.read_text().splitlines()
            )
            words = " ".join(line.lstrip("# ") for line in about)
            first = words.partition(". ")[0].rstrip(".") + "."
            yield f"[{path.name}](../../{path.relative_to(ROOT)})", first


def text(result: dict[str, Any]) -> str:
    """Return the page; `result` is the JSON form of a result."""
    unknown = set(result) - set(RESULT)
    if unknown or set(RESULT) - set(result):
        raise SystemExit(
            f"RESULT.json: {sorted(unknown ^ (set(RESULT) - set(result)))}"
        )
    optional = ("map", "recheck", VERIFICATION, "camera", *KEYS, *PARTS)
    sometimes = [key for key in optional if key not in RESULT]
    lines = [
        HEAD,
        "## PLAN.yaml",
        "",
        *table(("key", "meaning"), described(plan_keys(), PLAN, "PLAN.yaml")),
        "",
        "## RESULT.json",
        "",
        *table(("key", "meaning"), described(list(result), RESULT, "RESULT.json")),
        "",
        "Present only if requested, or if there is something to report:",
        "",
        *table(("key", "meaning"), described(sometimes, SOMETIMES, "RESULT.json")),
        "",
        "## Parameters of the nodes",
        "",
        "[config/params/all.yaml](../../config/params/all.yaml) has all of them: meaning, "
        "unit, bounds, default. Copy what differs for your cell into a file of your own, "
        "which the nodes and `--params NODES.yaml` read; `ros2 param describe` prints the "
        "same.",
        "",
    ]
    lines += [
        "## Messages, services, action",
        "",
        "Each field has its unit and frame in the definition; `ros2 interface show "
        "selfcal_msgs/msg/ErrorMap` prints it.",
        "",
        *table(("definition", "what"), message_rows()),
    ]
    return "\n".join(lines).rstrip() + "\n"


def example() -> dict[str, Any]:
    """Return the RESULT.json of a small simulated measurement."""
    import numpy as np

    from selfcal_ros.applications.papers.readings import hu_plan, simulate_measurements
    from selfcal_ros.estimation.api import calibrate
    from selfcal_ros.model.artifact import Artifact
    from selfcal_ros.reporting.words.findings import worded
    from selfcal_ros.simulation.machine import random_truth

    rng = np.random.default_rng(1)
    plan = hu_plan(Artifact(5, 0.01, 8), 2)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(
        truth, plan, rng, sigma_m=1e-8, sigma_theta_rad=1e-6
    )
    return result_to_dict(worded(calibrate(readings)))


def main() -> int:
    for path, content in ((PAGE, text(example())), (PARAMETERS, parameters_text())):
        write_text(path, content)
        print(path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
