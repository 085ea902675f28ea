# SPDX-License-Identifier: Apache-2.0
"""Calls of drivers and classes of others: whatever they raise becomes a `MachineError`."""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from selfcal_ros.errors import SelfcalError, first_line
from selfcal_ros.machine.interface import MachineError
from selfcal_ros.portable import Ended


def called(where: str, function: Callable[..., Any], *values: Any,
           remedy: str = "check cables, power and the driver", **more: Any) -> Any:
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
        For any error that is not one of this package, with the line of Python that raised it; also
        for the end of the program, unless a signal asks for that.
    """
    try:
        return function(*values, **more)
    except (SelfcalError, ModuleNotFoundError, Ended):
        raise
    except (Exception, SystemExit) as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        in_python = frame.filename != __file__  # else it was raised by a library in C
        place = f" ({Path(frame.filename).name}, line {frame.lineno})" if in_python else ""
        raise MachineError(f"{type(error).__name__}: {first_line(error)}{place}", where,
                           remedy) from error
