# SPDX-License-Identifier: Apache-2.0
"""The package's own modules: each is read and parsed once for all rules."""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "selfcal_ros"
SOURCES = sorted(PACKAGE.rglob("*.py"))


@dataclass(frozen=True)
class Source:
    """What the rules look at; the syntax tree itself would fill the memory.

    `imports` are those at the top, `late` those anywhere else.
    """

    text: str
    imports: tuple[ast.Import | ast.ImportFrom, ...]
    late: tuple[ast.Import | ast.ImportFrom, ...]


@cache
def source(path: Path) -> Source:
    """Return what the rules look at in a module."""
    text = path.read_text()
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    return Source(
        text,
        tuple(node for node in imports if node in tree.body),
        tuple(node for node in imports if node not in tree.body),
    )
