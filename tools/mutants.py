#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Change the code a little, run the tests that watch it, and print the changes that no test sees.

    tools/mutants.py [--number N] [--seed S] [--only PATH]... [--workers W]

A sample of small changes (a sign, a comparison, a factor, sin for cos, min for max, an index) over
selfcal_ros, without text and plots. Each is made in a copy of the tree, never in the tree itself.
Tests that mirror the module run first, then those of the packages that use it. A change that makes
the tests hang counts as seen.
"""

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "selfcal_ros"
LEFT_OUT = ("cli", "reporting", "start.py", "__main__.py", "units.py", "errors.py")
"""Text, plots, and what is nothing but names."""

TIMEOUT_S = 900
WIDER = {"estimation": ["test/estimation"], "laser": ["test/laser", "test/simulation"],
         "compensation": ["test/compensation"], "model": ["test/model", "test/estimation"],
         "simulation": ["test/simulation"], "collection": ["test/collection"],
         "messages": ["test/messages", "test/bagio"], "bagio": ["test/bagio"],
         "sessions": ["test/sessions", "test/nodes"], "nodes": ["test/nodes"]}
COMPARE = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
           ast.Eq: ("==", "!="), ast.NotEq: ("!=", "==")}
ARITHMETIC = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
NAMES = {"sin": "cos", "cos": "sin", "min": "max", "max": "min", "any": "all", "all": "any",
         "minimum": "maximum", "maximum": "minimum", "argmax": "argmin", "argmin": "argmax"}


@dataclass(frozen=True)
class Mutant:
    """A change: the text from `start` to `stop` of a file becomes `new`."""

    path: str
    start: int
    stop: int
    new: str
    line: int

    def applied(self, text: str) -> str:
        """Return the text of the file with the change."""
        data = text.encode()
        return (data[:self.start] + self.new.encode() + data[self.stop:]).decode()


class Source:
    """The text of a file, and where its nodes stand in it, in bytes."""

    def __init__(self, text: str) -> None:
        self.text, self.data = text, text.encode()
        self.offsets = [0]
        for line in self.data.split(b"\n"):
            self.offsets.append(self.offsets[-1] + len(line) + 1)

    def place(self, node: ast.AST) -> tuple[int, int]:
        """Return where a node begins and ends."""
        return (self.offsets[node.lineno - 1] + node.col_offset,
                self.offsets[node.end_lineno - 1] + node.end_col_offset)

    def sign(self, left: ast.AST, right: ast.AST, old: str, new: str) -> tuple | None:
        """Return the change of the operator that stands between two nodes."""
        at = self.data.find(old.encode(), self.place(left)[1], self.place(right)[0])
        return (at, at + len(old), new) if at >= 0 else None

    def inner(self, node: ast.AST) -> str:
        """Return the text of a node in brackets."""
        return f"({ast.get_source_segment(self.text, node)})"


def _operator(node: ast.AST, source: Source) -> tuple | None:
    if isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC and not _is_text(node):
        return source.sign(node.left, node.right, *ARITHMETIC[type(node.op)])
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARE:
        return source.sign(node.left, node.comparators[0], *COMPARE[type(node.ops[0])])
    if isinstance(node, ast.BoolOp):
        words = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        return source.sign(node.values[0], node.values[1], *words)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        return (*source.place(node), source.inner(node.operand))
    return None


def _name_or_number(node: ast.AST, source: Source) -> tuple | None:
    if isinstance(node, ast.Name) and node.id in NAMES:
        return (*source.place(node), NAMES[node.id])
    if isinstance(node, ast.Attribute) and node.attr in NAMES:
        stop = source.place(node)[1]
        return (stop - len(node.attr), stop, NAMES[node.attr])
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return (*source.place(node), {0: "1", 1: "0"}.get(node.value, f"({node.value} * 2)"))
    return None


def mutants_of(path: str, text: str) -> list[Mutant]:
    """Return all changes of one file."""
    source = Source(text)
    found = ((node, _operator(node, source) or _name_or_number(node, source))
             for node in _code(ast.parse(text)))
    return [Mutant(path, *change, node.lineno) for node, change in found if change]


def _is_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(isinstance(side, ast.JoinedStr) or (
        isinstance(side, ast.Constant) and isinstance(side.value, str)) for side in sides)


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that decide what is computed: no messages, types, defaults of decorators."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.Raise | ast.JoinedStr | ast.arg | ast.Import | ast.ImportFrom):
            continue
        if isinstance(tree, ast.FunctionDef) and child in (tree.returns, *tree.decorator_list):
            continue
        if isinstance(tree, ast.ClassDef) and child in tree.decorator_list:
            continue
        if isinstance(tree, ast.AnnAssign) and child is tree.annotation:
            continue
        yield child
        yield from _code(child)


def sample(number: int, seed: int, only: list[str]) -> list[Mutant]:
    """Return a seeded sample, as many from a long module as its length asks for."""
    found: list[Mutant] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        name = str(path.relative_to(ROOT))
        inner = path.relative_to(PACKAGE).parts[0]
        if (any(name.startswith(part.rstrip("/")) for part in only) if only
                else inner not in LEFT_OUT):
            found += mutants_of(name, path.read_text())
    return random.Random(seed).sample(found, min(number, len(found)))


def tests_for(path: str) -> list[list[str]]:
    """Return the tests that watch a module: its mirror first, then its package's."""
    parts = Path(path).with_suffix("").parts[1:]
    mirror = Path("test", *parts[:-1])
    own = sorted(str(p.relative_to(ROOT)) for p in (ROOT / mirror).glob(f"test_{parts[-1]}*.py"))
    near = [str(mirror)] if (ROOT / mirror).is_dir() else []
    wider = [folder for folder in WIDER.get(parts[0], []) if (ROOT / folder).is_dir()]
    return [group for group in (own, near, wider) if group]


def survives(mutant: Mutant, tree: Path, workers: int) -> bool:
    """Return whether no test sees the change in the copy `tree`."""
    path = tree / mutant.path
    text = path.read_text()
    path.write_text(mutant.applied(text))
    try:
        for group in tests_for(mutant.path):
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider",
                       "-n", str(workers), *group]
            done = subprocess.run(command, cwd=tree, capture_output=True, timeout=TIMEOUT_S,
                                  check=False)
            if done.returncode != 0:
                return False
        return True
    except subprocess.TimeoutExpired:
        return False
    finally:
        path.write_text(text)


def main() -> int:
    """Run the sample and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=40, help="changes to try (default: 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[], metavar="PATH",
                        help="file or folder, e.g. selfcal_ros/estimation; may be repeated")
    parser.add_argument("--workers", type=int, default=2, help="tests at a time (default: 2)")
    args = parser.parse_args()
    chosen = sample(args.number, args.seed, args.only)
    survivors = []
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                               check=True).stdout.split("\n")
        for name in filter(None, names):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
        for number, mutant in enumerate(chosen, 1):
            line = (tree / mutant.path).read_text().splitlines()[mutant.line - 1].strip()
            alive = survives(mutant, tree, args.workers)
            said = "SURVIVED" if alive else "seen"
            print(f"{number}/{len(chosen)} {said}: {mutant.path}:{mutant.line}: {line}  "
                  f"-> {mutant.new}", flush=True)
            survivors += [mutant] * alive
    print(f"{len(survivors)} of {len(chosen)} changes survived (seed {args.seed})")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
