# SPDX-License-Identifier: Apache-2.0
"""Calls of drivers and classes of others: whatever they raise becomes a `MachineError`."""

import contextlib
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from selfcal_ros.errors import SelfcalError, first_line
from selfcal_ros.machine.interface import MachineError
from selfcal_ros.portable import Ended

STDLIB = sysconfig.get_path("stdlib")
LIBRARIES = {"site-packages", "dist-packages"}
"""Names of folders of code in which nobody looks for a mistake of their own."""


def called(
    where: str,
    function: Callable[..., Any],
    *values: Any,
    remedy: str = "check cables, power and the driver",
    **keywords: Any,
) -> Any:
    """Return what a function returns.

    Parameters
    ----------
    where : str
        What is called, for the error.
    function : callable (*values, **more)
        The driver's.
    remedy : str
        What a person can do if it fails.

    Raises
    ------
    MachineError
        For any error that is not one of this package, with the last line of Python outside the
        libraries that led to it; also for the end of the program, unless a signal asks for that.
    """
    try:
        return function(*values, **keywords)
    except (SelfcalError, ModuleNotFoundError, Ended):
        raise
    except (Exception, SystemExit) as error:
        # none if a library in C raised it
        frames = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if frame.filename != __file__
        ]
        of_user = [
            frame
            for frame in frames
            if not frame.filename.startswith(STDLIB)
            and LIBRARIES.isdisjoint(Path(frame.filename).parts)
        ]
        place = "".join(
            f" ({Path(frame.filename).name}, line {frame.lineno})"
            for frame in (of_user or frames)[-1:]
        )
        raise MachineError(
            f"{type(error).__name__}: {first_line(error)}{place}", where, remedy
        ) from error


@contextlib.contextmanager
def stopping_on_error(stop: Callable[[], None]) -> Iterator[None]:
    """Stop a machine whose move fails."""
    try:
        yield
    except MachineError:
        with contextlib.suppress(MachineError):  # the caller stops as well
            stop()
        raise
