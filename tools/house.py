#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure what a reader has to follow: size of the code, names of the terms, constants, branches.

    tools/house.py [--terms microscope,yaw] [FOLDER ...]

One line a folder of Python code (default: the estimation, the whole package, and those of evo and
scikit-image where they are installed), then the files that name a term outside its block, its
sentences (`reporting/words`) and its simulation. `tools/entered.py` counts the functions and files
that a plain solution enters. Words in docstrings and comments do not count.
"""

import argparse
import ast
import io
import sys
import tokenize
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "selfcal_ros"
BESIDE = ("evo", "skimage.transform")
"""Packages beside which this one is read."""

SILENT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
KINDS = {
    "LatticePose",
    "PlacedPose",
    "LatticeViews",
    "PlacedViews",
    "PlacedSystem",
    "PlacedEquations",
    "map_grid",
}
"""Names by which a branch asks for the kind of pose or map."""


def docstrings(tree: ast.Module) -> set[int]:
    """Return the lines at which docstrings, also those of constants, begin."""
    return {
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    }


def tokens_of(text: str, silent_lines: set[int]) -> list[tokenize.TokenInfo]:
    """Return the tokens of a file without comments, layout and docstrings."""
    return [
        token
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in SILENT
        and not (token.type == tokenize.STRING and token.start[0] in silent_lines)
    ]


def is_number(node: ast.expr | None) -> bool:
    """Return whether an expression is made of numbers alone."""
    return (
        node is not None
        and any(
            isinstance(part, ast.Constant)
            and isinstance(part.value, int | float)
            and not isinstance(part.value, bool)
            for part in ast.walk(node)
        )
        and all(
            isinstance(
                part,
                ast.Constant
                | ast.BinOp
                | ast.UnaryOp
                | ast.Tuple
                | ast.operator
                | ast.unaryop
                | ast.expr_context,
            )
            and not (isinstance(part, ast.Constant) and isinstance(part.value, str))
            for part in ast.walk(node)
        )
    )


def constants(tree: ast.Module) -> int:
    """Return the numeric constants that a module declares."""
    return sum(
        len(node.targets) if isinstance(node, ast.Assign) else 1
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and is_number(node.value)
    )


def branches(tree: ast.Module) -> int:
    """Return the `isinstance` calls, and the conditions that name a kind of pose or map."""
    calls = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance"
    ]
    inside = {part for call in calls for part in ast.walk(call)}
    tests = [
        node.test
        for node in ast.walk(tree)
        if isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert)
    ]
    return len(calls) + sum(
        any(
            part not in inside
            and (
                getattr(part, "id", None) in KINDS
                or getattr(part, "attr", None) in KINDS
            )
            for part in ast.walk(test)
        )
        for test in tests
    )


def measured(folder: Path) -> dict[str, int]:
    """Return the figures of all Python files below a folder."""
    total = dict.fromkeys(("files", "lines", "tokens", "constants", "branches"), 0)
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        tokens = tokens_of(text, docstrings(tree))
        total["files"] += bool(tokens)
        total["lines"] += len(
            {
                line
                for token in tokens
                for line in range(token.start[0], token.end[0] + 1)
            }
        )
        total["tokens"] += len(tokens)
        total["constants"] += constants(tree)
        total["branches"] += branches(tree)
    return total


def names(path: Path, term: str) -> bool:
    """Return whether a file names a term: as text of its own, or as a whole word of a name."""
    text = path.read_text(encoding="utf-8")
    for token in tokens_of(text, docstrings(ast.parse(text))):
        if token.type == tokenize.STRING and token.string.strip("rbf\"'") == term:
            return True
        if token.type == tokenize.NAME and token.string.lower() == term:
            return True
    return False


def files_that_name(term: str) -> list[str]:
    """Return the files that name a term outside its block, its sentences and its simulation."""
    own = {PACKAGE / f"estimation/terms/{term}.py"}
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE)
        if (
            path not in own
            and place.parts[0] != "simulation"
            and place.parts[:2] != ("reporting", "words")
            and names(path, term)
        ):
            found.append(str(place))
    return found


def folder_of(name: str) -> Path | None:
    """Return the folder of an installed package; None if there is none."""
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        return None
    return None if spec is None or spec.origin is None else Path(spec.origin).parent


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--terms", default="microscope,yaw", help="names of terms (%(default)s)"
    )
    args = parser.parse_args()
    beside = [folder for name in BESIDE if (folder := folder_of(name)) is not None]
    print(
        f"{'':34}{'files':>7}{'lines':>8}{'tokens':>9}{'a line':>8}{'constants':>11}"
        f"{'branches':>10}"
    )
    for folder in args.folders or [PACKAGE / "estimation", PACKAGE, *beside]:
        one = measured(folder)
        shown = folder.relative_to(ROOT) if folder.is_relative_to(ROOT) else folder.name
        print(
            f"{shown!s:34}{one['files']:7}{one['lines']:8}{one['tokens']:9}"
            f"{one['tokens'] / max(one['lines'], 1):8.1f}{one['constants']:11}"
            f"{one['branches']:10}"
        )
    for term in args.terms.split(","):
        found = files_that_name(term)
        print(f"{term} is named in {len(found)} files: {' '.join(found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
