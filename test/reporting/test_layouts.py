# SPDX-License-Identifier: Apache-2.0
"""The shipped viewer layouts: well formed, and about topics and fields that exist."""

import json
import re
from pathlib import Path

import pytest
import yaml

from selfcal_ros.settings.nodes import NODE_PARAMETERS
from selfcal_ros.topics import IMAGE_TOPICS, MAP_MARKERS_TOPIC, PROGRESS_TOPIC

ROOT = Path(__file__).parents[2]
FOXGLOVE = ROOT / "config" / "foxglove" / "selfcal.json"
RVIZ = ROOT / "config" / "rviz" / "selfcal.rviz"
TYPES = {
    "/stage/mark_detections": "MarkDetection",
    "/selfcal/view_command": "ViewCommand",
    "/selfcal/view_status": "ViewStatus",
    "/selfcal/view_measurement": "ViewMeasurement",
    "/selfcal/error_map": "ErrorMap",
    "/selfcal/summary": "CalibrationSummary",
}


def fields_of(topic):
    """Return the fields of the message on a topic of the contract."""
    if topic == "/stage/joint_states":
        return {"header", "name", "position", "velocity", "effort"}
    text = (ROOT / "msg_defs" / "msg" / f"{TYPES[topic]}.msg").read_text()
    return set(
        re.findall(r"^[a-z]\S*\s+([a-z]\w*)\s*(?:#|$)", text, flags=re.MULTILINE)
    )


def leaves(node):
    """Yield the panel names in a Foxglove layout tree."""
    if isinstance(node, str):
        yield node
        return
    assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
    yield from leaves(node["first"])
    yield from leaves(node["second"])


@pytest.fixture
def foxglove():
    return json.loads(FOXGLOVE.read_text())


def test_every_foxglove_panel_is_placed_once(foxglove):
    placed = list(leaves(foxglove["layout"]))
    assert sorted(placed) == sorted(foxglove["configById"])
    assert all(
        re.fullmatch(r"(3D|Plot|RawMessages|DiagnosticSummary|Image)!\w+", name)
        for name in placed
    )


def test_every_foxglove_path_names_a_field_of_the_contract(foxglove):
    paths = [
        p["value"] for c in foxglove["configById"].values() for p in c.get("paths", [])
    ]
    assert len(paths) >= 10
    for path in paths:
        topic, field = re.fullmatch(
            r"(/[\w/]+)\.(\w+)(?:\[(?:\d+|:)\])?", path
        ).groups()
        assert field in fields_of(topic), path
    raw = {c["topicPath"] for c in foxglove["configById"].values() if "topicPath" in c}
    assert raw == {
        "/selfcal/summary",
        "/selfcal/view_command",
        f"/{PROGRESS_TOPIC}.data",
    }


def test_foxglove_shows_the_image_and_where_detections_were_rejected(foxglove):
    assert foxglove["configById"]["Image!camera"]["imageMode"]["imageTopic"] == (
        f"/{IMAGE_TOPICS['raw']}"
    )
    panel = foxglove["configById"]["Plot!rejected"]
    paths = [panel["xAxisPath"]["value"], panel["paths"][0]["value"]]
    assert paths == [f"/selfcal/view_measurement.rejected_{axis}[:]" for axis in "xy"]
    assert {"rejected_x", "rejected_y"} <= fields_of("/selfcal/view_measurement")


def shown(label: str, needle: str) -> bool:
    """Return whether the panel's fuzzy filter shows a status: the letters in their order."""
    place, label = -1, label.lower()
    for letter in re.sub(r"[^a-z0-9]", "", needle.lower()):
        place = label.find(letter, place + 1)
        if place < 0:
            return False
    return True


@pytest.mark.parametrize("namespace", ["", "cell1/"])
def test_the_foxglove_panel_of_nodes_shows_each_of_them_once(foxglove, namespace):
    """Pinned statuses stand on top, the others below if their label passes the filter."""
    panel = foxglove["configById"]["DiagnosticSummary!nodes"]
    # of a node whose parameter hardware_id is empty
    stage = namespace.strip("/") or "stage"
    pinned = set()
    for node in NODE_PARAMETERS:
        if f"|{stage}|{namespace}{node}|" in panel["pinnedIds"]:
            pinned.add(node)
        else:
            assert shown(f"{stage}: {namespace}{node}", panel["hardwareIdFilter"]), node
    assert len(pinned) == (4 if not namespace else 0)
    assert not shown("stage: solver", "selfcal")


def test_foxglove_shows_the_map_from_above_over_a_grid_larger_than_any_stage(foxglove):
    panel = foxglove["configById"]["3D!map"]
    assert panel["topics"] == {f"/{MAP_MARKERS_TOPIC}": {"visible": True}}
    grid = panel["layers"]["grid"]
    assert grid["size"] >= 1 and grid["size"] / grid["divisions"] == pytest.approx(0.01)
    frame = next(p.default for p in NODE_PARAMETERS["solver"] if p.name == "frame_id")
    assert panel["followTf"] == grid["frameId"] == frame
    camera = panel["cameraState"]
    assert (camera["phi"], camera["perspective"]) == (0, False)
    assert camera["near"] < camera["distance"] < camera["far"]


def test_rviz_layout_shows_the_stage_frame_from_above():
    layout = yaml.safe_load(RVIZ.read_text())
    manager = layout["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "stage"
    classes = [display["Class"] for display in manager["Displays"]]
    names = ("Grid", "MarkerArray", "Image", "Axes", "TF")
    assert classes == [f"rviz_default_plugins/{name}" for name in names]
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/TopDownOrtho"
    assert {panel["Class"] for panel in layout["Panels"]} >= {"rviz_common/Displays"}


def test_rviz_grid_is_larger_than_any_stage():
    layout = yaml.safe_load(RVIZ.read_text())
    grid = layout["Visualization Manager"]["Displays"][0]
    assert (
        grid["Cell Size"] == 0.01 and grid["Cell Size"] * grid["Plane Cell Count"] >= 1
    )
