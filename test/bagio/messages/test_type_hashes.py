# SPDX-License-Identifier: Apache-2.0
"""The definitions of version 1.0: publishers and bags of other versions agree in their hashes."""

import json
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

from selfcal_ros.bagio.schemas import hash_of

DIGESTS = {
    "action/RunCalibration": "288df6e7427e28219a05a43fc3788bf2e6516cb18f525ab2f66607e861a0d4bd",
    "msg/CalibrationSummary": "f510c060350ecc9b2027f8be96ba383140573ed67163cac307d9541c0e0663c3",
    "msg/ErrorMap": "74d53269f8e032c7bac95a0744ca35558123009f7b42bc60f0a2e22445009bf0",
    "msg/MarkDetection": "8dfe50c440f484c7549f3e01634964ab04514286aba423b88e5d32e09646e2c7",
    "msg/ViewCommand": "4b7fd36bad653fcd3d4232229f591e2626519afb1d622917a4c800ae83b33c7c",
    "msg/ViewMeasurement": "80ac2856c6b11462676489d4cf46687ea70d364afdbf259b6e9c49cd3fa6ff4b",
    "msg/ViewStatus": "dabeb340d728d3906bba72272115879851a10f9337af2ceec9b9d2ce8c8e2081",
    "srv/Correct": "f6e689693a9a1de1152400264b3b08f0f26e9ab76ea1d710cf40fc18ccdee083",
    "srv/LoadMap": "1475f229bca1248672e8744d8dbf89532af7d1453953770658b722725854787e",
    "srv/SaveMap": "d77bfe5723fb152967572be0153525fb12568d4873e503dc7c04d05a333d9bd2",
}
HASHES = {
    f"selfcal_msgs/{name}": f"RIHS01_{digest}" for name, digest in DIGESTS.items()
}
"""RIHS01 (REP-2011) of every type, which a further key of a plan must not change: `plan_keys`."""
ROOT = Path(__file__).parents[3] / "msg_defs"


def test_every_definition_is_held():
    files = [
        *ROOT.glob("msg/*.msg"),
        *ROOT.glob("srv/*.srv"),
        *ROOT.glob("action/*.action"),
    ]
    assert {f"selfcal_msgs/{file.parent.name}/{file.stem}" for file in files} == set(
        HASHES
    )
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == "1.0.0"


@pytest.mark.parametrize("name", [name for name in HASHES if "/msg/" in name])
def test_messages_are_those_of_version_1(name):
    assert hash_of(name) == HASHES[name], (
        "undo the change in msg_defs: a key of a plan travels by PLAN_KEYS in model/view.py"
    )


@pytest.mark.ros
@pytest.mark.skipif(find_spec("selfcal_msgs") is None, reason="needs selfcal_msgs")
@pytest.mark.parametrize("name", HASHES)
def test_what_is_built_has_the_hashes_of_version_1(name):
    parents = Path(find_spec("selfcal_msgs").origin).parents
    share = next(parent / "share" for parent in parents if (parent / "share").is_dir())
    built = json.loads((share / f"{name}.json").read_text())
    found = {entry["type_name"]: entry["hash_string"] for entry in built["type_hashes"]}
    assert found[name] == HASHES[name], "build the messages again: make setup"
