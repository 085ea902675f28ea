# SPDX-License-Identifier: Apache-2.0
"""The rules of the house: layers, where libraries may be imported, and room per file."""

import ast
from pathlib import Path

import pytest

from test.support.sources import PACKAGE, SOURCES, source

BASE = {"errors", "files", "memory", "outputs", "topics", "units"}
DOMAIN = {"model"} | BASE
ESTIMATION = {"estimation", "compensation"}
MIDDLE = {"messages", "bagio", "reporting", "collection", "simulation", "parallel"}
GUESTS = {"aerotech", "laser", "papers"}
"""What only the verbs import, so that the core does without it."""
MAY_IMPORT = {
    "errors": set(),
    "memory": set(),
    "topics": set(),
    "units": set(),
    "outputs": {"errors"},
    "files": {"errors", "outputs"},
    "model": BASE,
    **{name: DOMAIN | ESTIMATION for name in ESTIMATION},
    **{name: DOMAIN | ESTIMATION | MIDDLE for name in MIDDLE},
    "parallel": {"errors"},
    **{name: DOMAIN | ESTIMATION | MIDDLE for name in GUESTS},
    "batch": DOMAIN | ESTIMATION | MIDDLE,
    "sessions": DOMAIN | ESTIMATION | MIDDLE,
    "start": set(),
    "nodes": DOMAIN | ESTIMATION | MIDDLE | {"sessions", "start"},
    "cli": DOMAIN | ESTIMATION | MIDDLE | GUESTS | {"batch", "start"},
}
ONLY_IN = {
    "rclpy": "nodes", "mcap": "bagio", "rosbags": "bagio", "matplotlib": "reporting",
    "selfcal_msgs": "nodes", "sensor_msgs": "nodes", "diagnostic_msgs": "nodes",
    "std_srvs": "nodes", "std_msgs": "nodes",
}


def imports(path: Path) -> set[str]:
    """Return the dotted names that a module imports, wherever in the file."""
    found = set()
    for node in (*source(path).imports, *source(path).late):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_follow_the_layers(path):
    layer = layer_of(path)
    for name in imports(path):
        first, *rest = name.split(".")
        if first == "selfcal_ros" and rest and layer in MAY_IMPORT:
            allowed = MAY_IMPORT[layer] | {layer}
            assert rest[0] in allowed or rest[0] in ("__version__", "cli"), f"{layer} -> {name}"
        assert layer == ONLY_IN.get(first, layer), f"{name} belongs in {ONLY_IN.get(first)}/"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_keep_their_room(path):
    text = source(path).text
    limit = 200 if layer_of(path) == "nodes" else 400
    assert len(text.splitlines()) <= limit
    assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n")
    for line, name, body in source(path).functions:
        assert body <= 60, f"{path.name}:{line} {name} has {body} lines"


def test_no_stub_is_left():
    words = ("TO" + "DO", "FIX" + "ME", "NotImplemented" + "Error", "XX" + "X")
    for path in SOURCES:
        for word in words:
            assert word not in source(path).text, f"{path}: {word}"
