# SPDX-License-Identifier: Apache-2.0
"""SIM.yaml: what `selfcal simulate` is to simulate."""

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan, plan_from_dict
from selfcal_ros.simulation.cell import CellSettings, Event, plan_events
from selfcal_ros.simulation.faults import Faults, apply_faults
from selfcal_ros.simulation.truth import Spread, Truth, random_truth


@dataclass(frozen=True)
class Simulation:
    """A parsed SIM.yaml: plan, seed, spread of the truth, cell, faults, start time."""

    plan: Plan
    seed: int
    spread: Spread
    settings: CellSettings
    faults: Faults
    start_ns: int
    compression: str

    def run(self) -> tuple[Truth, list[tuple[int, Event]], dict[str, int]]:
        """Return the truth, the messages with their times of arrival, and the ledger of faults."""
        rng = np.random.default_rng(self.seed)
        truth = random_truth(self.plan.artifact, len(self.plan.views), rng, self.spread)
        events = list(plan_events(truth, self.plan, settings=self.settings, rng=rng,
                                  start_ns=self.start_ns))
        arrivals, ledger = apply_faults(events, self.faults, rng)
        return truth, arrivals, ledger


def read_simulation(path: str | Path) -> Simulation:
    """Return the simulation in a SIM.yaml.

    Keys: ``plan`` (a path beside the file, or a plan inline), ``seed``, ``truth`` {g, a,
    g_theta, a_theta, phi, t: standard deviations}, ``noise`` {sigma_xy, sigma_theta}, ``cell``
    {sense, encoder_rate, exposure_period, with_ids, declare_sigma, servo_sigma,
    servo_sigma_theta}, ``faults`` (fields of `Faults`), ``start_time`` (s), ``compression``.
    SI units.

    Raises
    ------
    InputError
        For an unknown key or a value of the wrong type.
    """
    where = str(path)
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(where, "not a mapping", "see docs/simulate.md")
    known = {"plan", "seed", "truth", "noise", "cell", "faults", "start_time", "compression"}
    for key in data:
        if key not in known:
            raise InputError(f"{where}: {key}", "unknown key", "known are " + ", ".join(
                sorted(known)))
    if "plan" not in data:
        raise InputError(where, "the key 'plan' is missing", "name a PLAN.yaml")
    plan = data["plan"]
    if isinstance(plan, str):
        source = Path(path).parent / plan
        plan = plan_from_dict(read_yaml(source), str(source))
    else:
        plan = plan_from_dict(plan, f"{where}: plan")
    compression = data.get("compression", "zstd")
    if compression not in ("zstd", "lz4", "none"):
        raise InputError(f"{where}: compression", f"{compression!r} is not known",
                         "choose zstd, lz4 or none")
    _check_plain(data, where)
    cell = _numbers({**data.get("cell", {}), **data.get("noise", {})}, f"{where}: cell, noise", {
        "sense": "sense", "encoder_rate": "encoder_rate_hz", "with_ids": "with_ids",
        "exposure_period": "exposure_period_s", "declare_sigma": "declare_sigma",
        "servo_sigma": "servo_sigma_m", "servo_sigma_theta": "servo_sigma_rad",
        "sigma_xy": "sigma_xy_m", "sigma_theta": "sigma_theta_rad"})
    if "sense" in cell:
        if cell["sense"] not in list(Sense):
            raise InputError(f"{where}: cell: sense", f"{cell['sense']!r} is not known",
                             f"choose one of {', '.join(Sense)}")
        cell["sense"] = Sense(cell["sense"])
    spread = _numbers(data.get("truth", {}), f"{where}: truth", {
        "g": "g_m", "a": "a_m", "g_theta": "g_theta_rad", "a_theta": "a_theta_rad",
        "phi": "phi_rad", "t": "t_m"})
    names = {field.name: field.name for field in fields(Faults)}
    names |= {name.removesuffix("_s"): name for name in names}
    faults = _numbers(data.get("faults", {}), f"{where}: faults", names)
    return Simulation(plan, int(data.get("seed", 0)), Spread(**spread), CellSettings(**cell),
                      Faults(**faults), round(float(data.get("start_time", 1.7e9)) * 1e9),
                      compression)


def _numbers(data: object, where: str, names: dict[str, str]) -> dict:
    if not isinstance(data, dict):
        raise InputError(where, "not a mapping", "see docs/simulate.md")
    out = {}
    for key, value in data.items():
        if key not in names:
            raise InputError(f"{where}: {key}", "unknown key", "known are " + ", ".join(names))
        if not isinstance(value, int | float | bool) and key != "sense":
            raise InputError(f"{where}: {key}", f"{value!r} is not a number", "mend the value")
        if key != "sense" and not 0 <= value < math.inf:
            raise InputError(f"{where}: {key}", f"{value!r} is negative or not finite",
                             "mend the value")
        out[names[key]] = value
    return out


def _check_plain(data: dict, where: str) -> None:
    """Refuse sections that are no mappings, and a seed or start time that is no number."""
    for key in ("cell", "noise"):
        if not isinstance(data.get(key, {}), dict):
            raise InputError(f"{where}: {key}", "not a mapping", "see docs/simulate.md")
    for key in ("seed", "start_time"):
        value = data.get(key, 0)
        if not isinstance(value, int if key == "seed" else int | float) or value < 0:
            raise InputError(f"{where}: {key}", f"{value!r} is not a number from 0 up",
                             "mend the value")
