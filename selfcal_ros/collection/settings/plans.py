# SPDX-License-Identifier: Apache-2.0
"""PLAN.yaml files, and the results that they name."""

from pathlib import Path

from selfcal_ros.files import read_json, read_yaml
from selfcal_ros.model.result import CalibrationResult, result_from_dict
from selfcal_ros.model.view import Plan, plan_from_dict, plan_to_dict


def read_plan(path: str | Path) -> Plan:
    """Return the plan in a PLAN.yaml.

    Raises
    ------
    InputError
        If it is none, or the result in ``artifact_from`` cannot be read.
    """
    return plan_of(read_yaml(path), str(path), Path(path).parent)


def plan_of(data: object, where: str, folder: Path) -> Plan:
    """Return the plan in a mapping; a known plate need not be described again.

    Parameters
    ----------
    data : object
        As `plan_from_dict` has it; ``artifact`` and ``map`` are those of the result in
        ``artifact_from`` unless they are given.
    where : str
        File name, for messages.
    folder : Path
        Folder in which relative names of results begin.
    """
    if not isinstance(data, dict) or not isinstance(data.get("artifact_from"), str):
        return plan_from_dict(data, where)
    source = str((folder / data["artifact_from"]).resolve())
    known = {} if "artifact" in data else plan_to_dict(
        Plan("", calibration_of(source).plate, ()))
    plate = {key: known[key] for key in ("artifact", "map") if key in known}
    return plan_from_dict(plate | data | {"artifact_from": source}, where)


def calibration_of(path: str) -> CalibrationResult:
    """Return the calibration in a RESULT.json.

    Raises
    ------
    InputError
        If there is none.
    """
    return result_from_dict(read_json(path), path)
