#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Record what the package computes, or compare it with a record of another tree.

    tools/same.py [--sessions N] [--only TEXT] RECORD.json.gz
    tools/same.py --against RECORD.json.gz [--only TEXT] [--within PART]

Solves every recorded bag by several models, and N (200) random simulated sessions: plans, sizes,
effects, noises, faults and options drawn from the number of the session. Every number of each
RESULT.json is recorded, and the names in it (grade, causes, views). Sentences are left out. A
comparison ends with exit code 1 where a value differs, in any bit or by more than PART of the
standard uncertainty of the map (rms); values of one tree alone are counted only. Of factors L of a
covariance L L' is compared, which the signs of singular vectors do not change. To record another
commit: run this file with PYTHONPATH set to its work tree.
"""

import argparse
import contextlib
import gzip
import io
import json
import os
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

for _libraries in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_libraries, "1")

import numpy as np  # noqa: E402  # once the number of threads is set

ROOT = Path(__file__).resolve().parents[1]
SENTENCES = {
    "sentence",
    "text",
    "reasons",
    "warnings",
    "advice",
    "created",
    "file",
    "version",
    "message",
    "rejected_text",
    "sha256",
    "action",
    "digest",
}
"""Keys whose values are words for a reader, or differ from run to run or with the last bit."""

FACTORS = "/covariance_terms/"
"""Where the factors of a result are."""

OPTIONS = (
    [],
    ["--model", "none"],
    ["--robust"],
    ["--validate"],
    ["--misalignment", "linear"],
    ["--theta-datum", "xy_axes"],
    ["--model", "drift"],
    ["--model", "plate_scale"],
    ["--microscope", "0:0:0"],
    ["--uncertainty", "never"],
    ["--budget"],
)
BAG_OPTIONS = (*OPTIONS, ["--method", "law"], ["--model", "microscope,drift"])
PLANS = ("hu", "hu_two_shifts", "resistant", "six_views", "qiao", "hu_repeated")
EFFECTS = {
    "microscope_scale": 1e-2,
    "microscope_rotation": 1e-2,
    "microscope_shear": 2e-3,
    "backlash_x": 5e-8,
    "backlash_y": 5e-8,
    "plate_scale": 2e-6,
    "plate_shape": 5e-8,
    "plate_strain": 1e-7,
    "plate_tilt": 1e-4,
    "line_eccentricity": 5e-6,
    "drift_linear": 1e-7,
    "drift_walk": 1e-7,
    "optical_tilt_x": 1e-3,
    "settling": 5e-8,
    "stage_bend": 3e-8,
    "pitch_error": 1e-5,
}
FAULTS = {
    "lost": 0.05,
    "duplicated": 0.02,
    "outliers": 0.02,
    "low_score": 0.02,
    "not_finite": 0.01,
    "unknown_mark": 0.01,
    "delay": 0.2,
}
ORDERS = ("serpentine", "raster", "there_and_back", "x_back_y_back", "random")


def session(number: int) -> tuple[dict[str, object], list[str]]:
    """Return the SIM.yaml of a random session, and the options of its solution."""
    draw = random.Random(number)
    physics = {
        name: draw.choice((-1, 1)) * size * draw.random()
        if "microscope" in name
        else size * draw.random()
        for name, size in EFFECTS.items()
        if draw.random() < 0.15
    }
    noise = {
        "sigma_xy": 2e-8 * 10 ** draw.uniform(-1, 1),
        "sigma_theta": 1.7e-5 * draw.random(),
    }
    if draw.random() < 0.2:
        noise["noise_ratio"] = 10 ** draw.uniform(-0.5, 0.5)
    if draw.random() < 0.1:
        noise = {}
    cell: dict[str, object] = {"with_ids": draw.random() < 0.7}
    if draw.random() < 0.5:
        cell["visit_order"] = draw.choice(ORDERS)
    if draw.random() < 0.3:
        cell["stop_sigma"] = 2e-5
    if draw.random() < 0.2:
        cell["sense"] = "plate_moves"
    faults = {
        name: part * draw.random()
        for name, part in FAULTS.items()
        if draw.random() < 0.1
    }
    simulation = {
        "plan": str(ROOT / f"config/plans/{draw.choice(PLANS)}.yaml"),
        "seed": number,
        "physics": physics,
        "noise": noise,
        "cell": cell,
        "faults": faults,
    }
    return simulation, draw.choice(OPTIONS) if draw.random() < 0.5 else []


def leaves(node: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Yield path and value of each number, name and array of a JSON document."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key not in SENTENCES:
                yield from leaves(value, f"{path}/{key}")
    elif isinstance(node, list):
        if any(isinstance(item, dict) for item in node):
            for place, item in enumerate(node):
                yield from leaves(item, f"{path}/{place}")
        else:  # an array, row by row
            yield path, node
    else:
        yield path, node


def _run(*words: str) -> tuple[int, str]:
    from selfcal_ros.cli.main import main

    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
        code = main(list(words))
    return code, shown.getvalue()


def solved(bag: Path, options: list[str], scratch: Path) -> dict[str, object]:
    """Return all values of the solution of one bag, its exit code among them."""
    result = scratch / "result.json"
    result.unlink(missing_ok=True)
    code, shown = _run("solve", str(bag), "-o", str(result), "--quiet", *options)
    values: dict[str, object] = {"/exit_code": code}
    if code == 1:
        values["/fault"] = shown[-300:]
    if result.exists():
        values |= dict(leaves(json.loads(result.read_text())))
    return values


def case(name: str) -> tuple[str, dict[str, object]]:
    """Return one case's name and values."""
    kind, _, rest = name.partition(" ")
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        if kind == "bag":
            bag, *options = rest.split()
            return name, solved(ROOT / "bags" / bag, options, scratch)
        simulation, options = session(int(rest))
        (scratch / "sim.yaml").write_text(json.dumps(simulation))  # JSON is YAML
        code, shown = _run(
            "simulate", str(scratch / "sim.yaml"), "-o", str(scratch / "bag")
        )
        if code:
            return name, {"/simulate": code, "/fault": shown[-300:]}
        return name, solved(scratch / "bag", options, scratch)


def record(names: list[str]) -> dict[str, dict[str, object]]:
    """Return the values of all cases, computed by two processes."""
    with ProcessPoolExecutor(2) as pool:
        done = {}
        for name, values in pool.map(case, names, chunksize=1):
            done[name] = values
            print(f"\r{len(done)}/{len(names)} ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return done


def differ(old: object, new: object, allowed: float, part: float) -> bool:
    """Return whether two values differ: numbers by more than `allowed` and a part of themselves."""
    if isinstance(old, list) and isinstance(new, list):
        return len(old) != len(new) or any(
            differ(one, other, allowed, part)
            for one, other in zip(old, new, strict=True)
        )
    if allowed and isinstance(old, int | float) and isinstance(new, int | float):
        return not abs(old - new) <= allowed + part * max(abs(old), abs(new))
    return old != new


def allowed_in(case: dict[str, object], part: float) -> float:
    """Return a part of the standard uncertainty of a case's map, m."""
    rows = case.get("/error_map/u_gx", [])
    u = [
        value
        for row in (rows if part and isinstance(rows, list) else [])
        for value in row
        if isinstance(value, float)
    ]
    return part * (sum(value**2 for value in u) / len(u)) ** 0.5 if u else 0.0


def factors_of(case: dict[str, object]) -> list[np.ndarray]:
    """Return the factors of a case as columns: over the map, and over each thing beside it."""

    def rows(name: str) -> np.ndarray:
        found = np.array(case.get(f"{FACTORS}{name}", []), dtype=float)
        return found.reshape(len(found), found[:1].size)

    of_map, shared = rows("factors"), int(str(case.get(f"{FACTORS}beside/with_map", 0)))
    parts = [of_map]
    for name in ("plate", "lines", "microscope"):
        beside = rows(f"beside/{name}")
        # the first belong to factors of the map, the others leave it as it is
        if len(beside):
            other = np.zeros((len(of_map) - shared, beside.shape[1]))
            parts.append(np.concatenate([beside[:shared], other, beside[shared:]]))
    most = max(map(len, parts))
    return [np.pad(part, ((0, most - len(part)), (0, 0))) for part in parts]


def same_covariance(
    old: dict[str, object], new: dict[str, object], part: float
) -> bool:
    """Return whether L L' agrees, to a part of the largest variance of map, plate and lines."""
    before, after = factors_of(old), factors_of(new)
    if [columns.shape[1] for columns in before] != [
        columns.shape[1] for columns in after
    ]:
        return False
    size = np.concatenate(
        [
            np.full(
                columns.shape[1], np.sqrt((columns**2).sum(axis=0)).max(initial=0.0)
            )
            for columns in before
        ]
    )
    one, other = (np.hstack(columns) for columns in (before, after))
    return bool(
        (abs(one.T @ one - other.T @ other) <= part * np.outer(size, size)).all()
    )


def compare(
    before: dict[str, dict[str, object]],
    after: dict[str, dict[str, object]],
    part: float = 0.0,
) -> int:
    """Print which values differ, and return how many cases have any."""
    different = 0
    alone: Counter[str] = Counter()
    for name in before.keys() & after.keys():
        old, new = before[name], after[name]
        allowed = allowed_in(old, part)
        wrong = [
            path
            for path in old.keys() & new.keys()
            if not path.startswith(FACTORS)
            and differ(old[path], new[path], allowed, 0.0 if "_map/" in path else part)
        ]
        if not same_covariance(old, new, part):
            wrong.append(FACTORS)
        for path in old.keys() ^ new.keys():
            alone["/".join(part for part in path.split("/") if not part.isdigit())] += 1
        if wrong:
            different += 1
            first = sorted(wrong)[0]
            print(
                f"{name}: {len(wrong)} values differ, first {first}: "
                f"{str(old.get(first))[:80]} -> {str(new.get(first))[:80]}"
            )
    for path, count in sorted(alone.items()):
        print(f"in one tree alone: {path} ({count} times)")
    print(f"{len(before.keys() & after.keys())} cases, {different} differ")
    return different


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("record", type=Path, metavar="RECORD.json.gz")
    parser.add_argument(
        "--against", action="store_true", help="compare with RECORD.json.gz"
    )
    parser.add_argument("--sessions", type=int, default=200, metavar="N")
    parser.add_argument(
        "--only", default="", metavar="TEXT", help="cases with TEXT in their name"
    )
    parser.add_argument(
        "--within",
        type=float,
        default=0.0,
        metavar="PART",
        help="numbers may differ by this part of u; default: by no bit",
    )
    args = parser.parse_args()
    if args.against:
        before = json.loads(gzip.decompress(args.record.read_bytes()))
        names = [name for name in before if args.only in name]
        return 1 if compare(before, record(names), args.within) else 0
    bags = sorted(bag.name for bag in (ROOT / "bags").iterdir() if bag.is_dir())
    names = [
        " ".join(("bag", bag, *options)) for bag in bags for options in BAG_OPTIONS
    ]
    names += [f"session {number}" for number in range(args.sessions)]
    done = record([name for name in names if args.only in name])
    args.record.write_bytes(gzip.compress(json.dumps(done).encode()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
