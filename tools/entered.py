# SPDX-License-Identifier: Apache-2.0
"""Count the functions and files that one plain ``selfcal solve`` enters: what a reader follows.

    .venv/bin/python tools/entered.py [BAG]

A file is entered with the first function of it that runs. A return is a function entered for the
first time in a file that was left for another before.
"""

import argparse
import inspect
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "selfcal_ros"
BAG = ROOT / "bags" / "hu_noise"


@dataclass
class Walk:
    """The functions that ran, in the order of their first calls, and the modules loaded."""

    root: Path
    functions: list[tuple[Path, int, str]] = field(default_factory=list)
    loaded: list[Path] = field(default_factory=list)

    def note(self, code: CodeType, _: int) -> object:
        """Keep one code object; `sys.monitoring` calls it once for each."""
        path = Path(code.co_filename)
        if path.is_relative_to(self.root):
            if code.co_name == "<module>":
                self.loaded.append(path)
            elif code.co_flags & inspect.CO_OPTIMIZED and not code.co_name.startswith(
                "<"
            ):
                self.functions.append((path, code.co_firstlineno, code.co_qualname))
        return sys.monitoring.DISABLE

    @property
    def files(self) -> set[Path]:
        """Files of which a function ran."""
        return {path for path, *_ in self.functions}

    @property
    def returns(self) -> int:
        """First calls in a file that was left for another before."""
        left: set[Path] = set()
        count, last = 0, None
        for path, *_ in self.functions:
            if path != last:
                count += path in left
                left.add(path)
            last = path
        return count


def walk(call: Callable[[], object], root: Path) -> Walk:
    """Run `call` and return the functions of files below `root` that it enters."""
    monitoring, tool = sys.monitoring, sys.monitoring.PROFILER_ID
    found = Walk(root)
    monitoring.use_tool_id(tool, "entered")
    try:
        monitoring.register_callback(tool, monitoring.events.PY_START, found.note)
        monitoring.set_events(tool, monitoring.events.PY_START)
        monitoring.restart_events()
        call()
    finally:
        monitoring.set_events(tool, 0)
        monitoring.free_tool_id(tool)
    return found


def table(found: Walk) -> str:
    """Return functions, files entered, loaded and there, a line for each package, and returns."""

    def by_package(paths: Iterable[Path]) -> Counter:
        return Counter(
            path.relative_to(found.root).parts[0].removesuffix(".py") for path in paths
        )

    there = [path for path in found.root.rglob("*.py") if path.name != "__init__.py"]
    columns = [
        by_package(path for path, *_ in found.functions),
        by_package(found.files),
        by_package(path for path in found.loaded if path.name != "__init__.py"),
        by_package(there),
    ]
    rows = [
        (name, *(column[name] for column in columns)) for name in sorted(columns[3])
    ]
    rows.append(("all", *(column.total() for column in columns)))
    lines = ["package       functions  files  loaded  there"]
    lines += [
        f"{name:14}{functions:9d}{files:7d}{loaded:8d}{all_:7d}"
        for name, functions, files, loaded, all_ in rows
    ]
    return "\n".join([*lines, f"returns to a file left before: {found.returns}"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag", nargs="?", default=str(BAG))
    parser.add_argument(
        "--files", action="store_true", help="list the files and their functions"
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:

        def solve() -> None:
            from selfcal_ros.cli.main import main as selfcal

            selfcal(["solve", args.bag, "-o", str(Path(folder) / "result.json")])

        found = walk(solve, PACKAGE)
    if args.files:
        for path, number in Counter(path for path, *_ in found.functions).items():
            print(f"{number:4d} {path.relative_to(PACKAGE)}")
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
