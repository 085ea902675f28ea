# SPDX-License-Identifier: Apache-2.0
"""The rules of the house: layers, where libraries may be imported, and licences."""

import ast
import re
from pathlib import Path

import pytest

from test.support.sources import PACKAGE, ROOT, SOURCES, source

BASE = {
    "blocks": {"errors"},
    "errors": set(),
    "topics": set(),
    "units": set(),
    "plain_numbers": set(),
    "portable": set(),
    "start": {"topics"},
    "outputs": {"errors", "portable"},
    "files": {"errors", "outputs", "portable"},
    "results": {"errors", "files", "model"},
}
"""Modules that any package may import (`start`: the edges), and what they import."""
ROW = re.compile(r"\| `(\w+)` \|[^|]*\|([^|]*)\|")
ONLY_IN = {
    "rclpy": "nodes",
    "mcap": "bagio",
    "rosbags": "bagio",
    "matplotlib": "reporting",
    "selfcal_msgs": "nodes",
    "sensor_msgs": "nodes",
    "diagnostic_msgs": "nodes",
    "std_srvs": "nodes",
    "std_msgs": "nodes",
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


def documented() -> dict[str, set[str]]:
    """Return package -> packages that it imports, from the top to the bottom of the table."""
    page = (ROOT / "docs/theory/architecture.md").read_text()
    section = page.partition("## Layers")[2].partition("Inside `estimation`")[0]
    return {
        name: set(re.findall(r"`(\w+)`", cell)) for name, cell in ROW.findall(section)
    }


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def test_the_table_names_every_package():
    alone = {"__init__", "__main__", "forked"}  # import nothing but `start`
    layers = {layer_of(path) for path in SOURCES} - alone
    assert layers == {*documented(), *BASE}, (
        "in the table of docs/theory/architecture.md, or in BASE above, add or remove "
        f"{sorted(layers ^ {*documented(), *BASE})}"
    )


@pytest.mark.parametrize("layer", [*documented(), *BASE])
def test_packages_import_what_the_table_states(layer):
    table = documented()
    found = {
        name.split(".")[1]
        for path in SOURCES
        if layer_of(path) == layer
        for name in imports(path)
        if name.startswith("selfcal_ros.")
    } & {*table, *BASE}
    if layer in BASE:
        assert found - {layer} == BASE[layer], (
            f"correct BASE['{layer}'] above, or the import"
        )
    else:
        places = list(table)
        others = found - {layer, "model", *BASE}
        assert others == table[layer], (
            f"the row `{layer}` of docs/theory/architecture.md and its imports differ in "
            f"{sorted(others ^ table[layer])}: correct the row, or move what is imported"
        )
        above = [
            other
            for other in table[layer]
            if places.index(other) <= places.index(layer)
        ]
        assert not above, f"`{layer}` imports what is above it: move it out of {above}"
        assert "start" not in found or layer in ("cli", "nodes")


def test_libraries_are_imported_in_one_place_each():
    for path in SOURCES:
        for name in imports(path):
            place = ONLY_IN.get(name.partition(".")[0], layer_of(path))
            assert layer_of(path) == place, f"{path}: {name} belongs elsewhere"


def test_sessions_decide_without_ros():
    of_ros = {library for library, place in ONLY_IN.items() if place == "nodes"}
    for path in (PACKAGE / "nodes/sessions").glob("*.py"):
        used = {name.partition(".")[0] for name in imports(path)}
        assert not used & of_ros, f"{path}: {used & of_ros} belongs into a node"


def test_every_module_names_its_licence():
    first = "# SPDX-License-Identifier: Apache-2.0\n"
    assert [path for path in SOURCES if not source(path).text.startswith(first)] == []


def test_people_read_micrometres_and_degrees_as_symbols():
    """`um` and `deg` are what is typed, and what stands in files and names that are ASCII."""
    in_ascii = {"compensation/export.py", "nodes/filling.py"}  # comments; RViz's font
    found = [
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in SOURCES
        for line in source(path).text.splitlines()
        if re.search(r"\} um\b|\b(is it|are) in um\b|[\d}] deg\b", line)
        and str(path.relative_to(PACKAGE)) not in in_ascii
    ]
    assert not found


def test_no_stub_is_left():
    words = ("TO" + "DO", "FIX" + "ME", "NotImplemented" + "Error", "XX" + "X")
    for path in SOURCES:
        for word in words:
            assert word not in source(path).text, f"{path}: {word}"
