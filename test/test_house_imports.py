# SPDX-License-Identifier: Apache-2.0
"""The graph of imports: no circles, arrows downwards, imports in functions with a reason."""

import ast
from functools import cache
from pathlib import Path

import pytest

from selfcal_ros.settings.nodes import NODE_PARAMETERS
from test.support.sources import PACKAGE, ROOT, SOURCES, source

PARTS = {
    "estimation": (
        "options",
        "checks",
        "lattice",
        "multifrontal",
        "normal",
        "terms",
        "datum",
        "observability",
        "joint",
        "verdict",
        "comparison",
        "recheck",
        "quality",
        "api",
    ),
    "applications": (
        "laser",
        "papers",
        "batch",
        "aerotech",
        "controllers",
        "standards",
    ),
    "bagio": ("messages",),
    "nodes": ("sessions",),
}
"""The parts of packages: each imports only those before it, and no module beside them."""


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(
        ".__init__"
    )


NAMES = {dotted(path) for path in SOURCES}


def imports(path: Path, *, late: bool = True) -> set[str]:
    """Return the modules of this package that a module names in its imports.

    Those inside of functions are left out unless `late`.
    """
    found = set()
    for node in (*source(path).imports, *(source(path).late if late else ())):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in NAMES else node.module)
        else:
            found |= {alias.name for alias in node.names}
    return found & NAMES


@cache
def graph() -> dict[str, set[str]]:
    """Return the modules that each module imports."""
    return {dotted(path): imports(path) - {dotted(path)} for path in SOURCES}


def circle_in(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules of a circle of imports; empty if there is none."""
    done: set[str] = set()

    def visit(module: str, way: list[str]) -> list[str]:
        if module in way:
            return [*way[way.index(module) :], module]
        if module in done:
            return []
        for other in sorted(graph.get(module, ())):
            if found := visit(other, [*way, module]):
                return found
        done.add(module)
        return []

    for module in sorted(graph):
        if found := visit(module, []):
            return found
    return []


def test_a_circle_would_be_found():
    assert circle_in({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == [
        "b",
        "c",
        "b",
    ]
    assert circle_in({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_no_module_imports_itself_through_others():
    assert circle_in(graph()) == []


@pytest.mark.parametrize("package", PARTS)
def test_the_parts_of_a_package_import_only_those_before_them(package):
    parts = PARTS[package]
    inside = f"selfcal_ros.{package}."

    def place_of(module: str) -> int:
        part = module.removeprefix(inside).partition(".")[0]
        return parts.index(part) if part in parts else len(parts)

    modules = sorted(name for name in NAMES if name.startswith(inside))
    for module in modules:
        for other in graph()[module].intersection(modules):
            assert place_of(other) <= place_of(module), (
                f"{module} imports the later {other}: move what they share to an earlier part"
            )


def test_every_part_of_a_package_has_its_place():
    for package, parts in PARTS.items():
        folders = {path.parent.name for path in (PACKAGE / package).glob("*/*.py")}
        assert folders <= {*parts}, f"give {folders - {*parts}} a place in PARTS"


def test_imports_in_functions_state_their_reason():
    for path in SOURCES:
        lines = source(path).text.splitlines()
        for node in source(path).late:
            statement = "\n".join(lines[node.lineno - 1 : node.end_lineno])
            assert "  # " in statement, (
                f"{dotted(path)}:{node.lineno}: say why it is not at the top"
            )


WITH_SCIPY = {"solver", "mark_detector"}
"""The nodes that always compute with it: half a second and 30 MB at each start of a process."""


def loaded(path: Path) -> set[Path]:
    """Return the modules of this package that are loaded with a module, itself included."""
    files = {dotted(source): source for source in SOURCES}
    found, waiting = set(), [path]
    while waiting:
        found.add(path := waiting.pop())
        waiting += {files[name] for name in imports(path, late=False)} - found
    return found


def names_scipy(path: Path) -> bool:
    return any(
        (
            node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
        ).partition(".")[0]
        == "scipy"
        for node in source(path).imports
    )


@pytest.mark.parametrize("node", NODE_PARAMETERS)
def test_only_nodes_that_compute_with_scipy_load_it(node):
    with_scipy = [
        dotted(path)
        for path in loaded(PACKAGE / "nodes" / f"{node}.py")
        if names_scipy(path)
    ]
    assert bool(with_scipy) == (node in WITH_SCIPY), with_scipy
