# SPDX-License-Identifier: Apache-2.0
"""The recorded bags and what their manifest says of them."""

from pathlib import Path

import pytest
import yaml

from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.reporting.summary.numbers import map_figures

BAGS = Path(__file__).parents[2] / "bags"
MANIFEST = yaml.safe_load((BAGS / "manifest.yaml").read_text())
OF_IMAGES = [name for name, entry in MANIFEST.items() if "detect" in entry]


def require_map(name: str, emap: ErrorMap) -> None:
    """Require that a map is the one that the manifest states, to half a nm and half a nrad.

    Processors round differently: marks in images move by some 1e-7 pixels.
    """
    expected = MANIFEST[name]["expected"]
    found = {
        "max_error_um": map_figures(emap).max_error_m * 1e6,
        "nonorthogonality_urad": emap.nonorthogonality * 1e6,
        "scale_difference_ppm": emap.scale_difference * 1e6,
    }
    assert found == pytest.approx({key: expected[key] for key in found}, abs=5e-4)
