# SPDX-License-Identifier: Apache-2.0
"""The oldest libraries: what setup.py allows is what `make test-oldest` tries.

The list of names is of those that tempt and came later; that the rest works is tried by running
the suite on the oldest versions.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = sorted(
    [
        *(ROOT / "selfcal_ros").rglob("*.py"),
        *(ROOT / "tools").glob("*.py"),
        *(ROOT / "test").rglob("*.py"),
    ]
)
TOO_NEW = {
    "SciPy 1.12": {"eye_array", "diags_array", "block_array", "random_array"},
    "NumPy 2": {
        "concat",
        "cumulative_prod",
        "cumulative_sum",
        "isdtype",
        "matrix_norm",
        "matrix_transpose",
        "matvec",
        "permute_dims",
        "trapezoid",
        "unstack",
        "unique_counts",
        "unique_values",
        "vecdot",
        "vecmat",
        "vector_norm",
    },
    "Matplotlib 3.7": {"ecdf", "grouped_bar", "set_loc"},
}
OLDEST_WHEEL = {"lz4": "4.3"}
"""Tried with this: what Ubuntu 24.04 has older is not to be had for Python 3.12 as a wheel."""


def version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split("."))


def floors() -> dict[str, str]:
    """Return the lower bounds of setup.py by name."""
    text = (ROOT / "setup.py").read_text()
    return dict(re.findall(r'"([a-z0-9]+)>=([\d.]+)"', text))


def pins() -> dict[str, str]:
    """Return the versions of tools/oldest.txt by name."""
    return dict(
        line.split()[0].split("==")
        for line in (ROOT / "tools/oldest.txt").read_text().splitlines()
        if not line.startswith("#")
    )


def test_what_setup_allows_is_what_is_tried():
    pinned = pins()
    for name in ("numpy", "scipy", "pytest", "hypothesis", "matplotlib"):
        tried = pinned[name].split(".")
        floor = OLDEST_WHEEL.get(name, floors()[name])
        assert ".".join(tried[: floor.count(".") + 1]) == floor, name
    for name, floor in floors().items():
        if name in pinned:
            assert version(pinned[name]) >= version(floor), name


def test_every_replaced_pin_is_one_of_the_environment():
    own = {
        line.split("==")[0]
        for line in (ROOT / "tools/requirements.txt").read_text().splitlines()
        if "==" in line
    }
    # needed by the old versions alone
    assert set(pins()) - own == {"attrs", "six", "wheel"}


@pytest.mark.parametrize("library", TOO_NEW)
def test_no_name_is_newer_than_the_floor(library):
    words = re.compile(rf"\b(?:{'|'.join(TOO_NEW[library])})\b")
    for path in CODE:
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if words.search(text) else ():
            used = (
                {node.attr}
                if isinstance(node, ast.Attribute)
                else {alias.name for alias in node.names}
                if isinstance(node, ast.ImportFrom)
                else set()
            )
            assert not used & TOO_NEW[library], (
                f"{path}:{node.lineno}: {used} came with {library}"
            )


def test_least_squares_name_their_cut():
    """NumPy 1.26 warns of another default where there is no `rcond`."""
    calls = [
        (file.name, node.lineno, {keyword.arg for keyword in node.keywords})
        for file in CODE
        if "np.linalg.lstsq" in (text := file.read_text())
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "lstsq"
    ]
    assert calls
    assert [call[:2] for call in calls if "rcond" not in call[2]] == []
