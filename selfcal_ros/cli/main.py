# SPDX-License-Identifier: Apache-2.0
"""The ``selfcal`` command: find the verbs, run one, turn errors into exit codes.

A verb is a module of this package with ``HELP`` (one line), ``configure(parser)`` and
``run(args) -> int``; ``step_diagonal.py`` is the verb ``step-diagonal``. Verb modules import
slow modules inside ``run``.
"""

import argparse
import importlib
import os
import pkgutil
import signal
import sys
from types import ModuleType

from selfcal_ros import __version__, cli
from selfcal_ros.cli.terminal import Parser
from selfcal_ros.errors import ExitCode, InputError, SelfcalError

COMPLETE = "_ARGCOMPLETE"
"""Set in the environment by a shell that asks for completions."""


def verbs(only: str | None = None) -> dict[str, ModuleType]:
    """Return name -> module of every verb, or of `only` alone; empty if that is not a verb."""
    modules = {}
    for info in pkgutil.iter_modules(cli.__path__):
        name = info.name.replace("_", "-")
        if only in (None, name):
            module = importlib.import_module(f"{cli.__name__}.{info.name}")
            if hasattr(module, "HELP"):
                modules[name] = module
    return modules


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Return the parser with one sub-parser per verb, or that of `only` alone if it is a verb.

    A command that begins with a verb needs no other sub-parser.
    """
    parser = Parser(
        prog="selfcal", description="Self-calibration of XY-theta stages.",
        epilog="exit codes: 0 done, 2 bad usage or input, 3 the measured plan does not identify "
               "the stage, 4 no usable data, 5 not qualified, 1 internal error")
    parser.add_argument("--version", action="version", version=f"selfcal {__version__}")
    group = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, module in (verbs(only) or verbs()).items():
        sub = group.add_parser(name, help=module.HELP, description=module.HELP)
        module.configure(sub)
        sub.set_defaults(run=module.run)
    return parser


def _complete(parser: argparse.ArgumentParser) -> None:
    """Answer a shell's request for completions and end; see README."""
    import argcomplete

    argcomplete.autocomplete(parser)


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    said = "selfcal"
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked by `start`
        if COMPLETE in os.environ:
            _complete(build_parser())
        words = sys.argv[1:] if argv is None else argv
        parser = build_parser(words[0] if words else None)
        args = parser.parse_args(argv)
        args.words = words
        said = f"selfcal {args.verb}"
        code = int(args.run(args))
        sys.stdout.flush()
        return code
    except SelfcalError as error:
        print(f"{said}: {error}", file=sys.stderr)
        return int(error.exit_code)
    except KeyboardInterrupt:
        print(f"{said}: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return int(ExitCode.DONE)
    except ModuleNotFoundError as error:
        print(f"{said}: there is no module {error.name} in this environment; install it, see "
              "README", file=sys.stderr)
        return int(ExitCode.BAD_INPUT)
    except OSError as error:  # a name too long, a disk that fails
        if error.errno is None:
            raise
        fault = InputError(error.filename or "system", str(error.strerror),
                           "check path, disk and permissions")
        print(f"{said}: {fault}", file=sys.stderr)
        return int(fault.exit_code)
