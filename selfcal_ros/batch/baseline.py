# SPDX-License-Identifier: Apache-2.0
"""The maps of a batch compared with one map, the baseline: which machines or days have changed.

Each whole map is tested against it as in `selfcal diff`; the tests of all maps are corrected
together (Benjamini and Hochberg), so that a map of stable machines is rarely named.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import false_discovery_control

from selfcal_ros.batch.folder import Record
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import MapDifference, compare
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.results import read_result
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

LEVEL = 0.05
"""Part of the named maps that may be named by chance."""


def compared(records: Sequence[Record], folder: Path, baseline: CalibrationResult,
             where: str) -> list[Record]:
    """Return the records with `baseline` and further quantities, where their map can be compared.

    `baseline`: {p, adjusted_p, changed}. The quantities are largest and rms difference, datum
    difference removed. A map that cannot be compared has the reason in `not_compared`.

    Parameters
    ----------
    records : sequence of dict
        Records of bags; those without a map remain as they are.
    folder : Path
        Folder of the batch.
    baseline : CalibrationResult
        The map to compare with.
    where : str
        Its file, for the reasons.
    """
    tried = {number: _difference(record, folder, baseline, where)
             for number, record in enumerate(records)
             if record.get("quantities") and "result" in record}
    found = {number: difference for number, difference in tried.items()
             if isinstance(difference, MapDifference)}
    records = [record | {"not_compared": tried[number]}
               if isinstance(tried.get(number), str) else record
               for number, record in enumerate(records)]
    p = {number: value for number, difference in found.items()
         if np.isfinite(value := probability(difference))}
    adjusted = dict(zip(p, false_discovery_control(list(p.values())), strict=True)) if p else {}
    return [record if number not in found else record | {
        "quantities": record["quantities"] | _quantities(found[number]),
        "baseline": None if number not in p else {
            "p": p[number], "adjusted_p": float(adjusted[number]),
            "changed": bool(adjusted[number] <= LEVEL)}}
        for number, record in enumerate(records)]


def probability(difference: MapDifference) -> float:
    """Return the probability of a difference as large in any of its tests; NaN without tests.

    The distance of all nodes and the largest one, of XY and theta: the smallest times their number.
    """
    tests = [test for test in (difference.xy, difference.theta) if test is not None]
    values = [p for test in tests for p in (test.p, test.p_z) if np.isfinite(p)]
    return min(min(values) * len(values), 1.0) if values else float("nan")


def _difference(record: Record, folder: Path, baseline: CalibrationResult,
                where: str) -> MapDifference | str:
    file = folder / record["result"]
    try:
        return compare(baseline, read_result(file), names=(where, str(file)))
    except InputError as error:  # another lattice, or nothing that both know
        return error.what


def _quantities(difference: MapDifference) -> dict[str, float | None]:
    found = {"difference_from_baseline_rms_um": difference.rms_m * UM_PER_M,
             "difference_from_baseline_largest_um": difference.max_m * UM_PER_M,
             "theta_difference_from_baseline_rms_arcsec":
                 difference.rms_theta_rad * ARCSEC_PER_RAD}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def sentence(records: Sequence[Record], where: str) -> str:
    """Return which maps differ from the baseline, in one sentence."""
    tested = [record for record in records if record.get("baseline")]
    changed = [record for record in tested if record["baseline"]["changed"]]
    named = ", ".join(f"{record['bag']} (p = {record['baseline']['adjusted_p']:.2g})"
                      for record in changed)
    others = Counter(record["not_compared"] for record in records if "not_compared" in record)
    return (f"{len(changed)} of {len(tested)} maps differ from {where}"
            + (f": {named}" if changed else "")
            + "".join(f"; not compared: {count} ({reason})" for reason, count in others.items()))
