# SPDX-License-Identifier: Apache-2.0
"""The interface of a machine: a stage, and a camera or another sensor that sees marks.

SI units throughout: m, rad, ns since 1970. Positions are the machine's own, as it indicates them;
CELL.yaml states where the centre of the field is.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from selfcal_ros.errors import InputError


class MachineError(InputError):
    """Raised by a machine, or by what drives it, when it does not do what it was told.

    Parameters
    ----------
    what : str
        What happened, with figures.
    where : str, optional
        The axis, the camera, the port.
    remedy : str, optional
        What a person can do about it.
    """

    def __init__(self, what: str, where: str = "machine", remedy: str = "") -> None:
        super().__init__(where, what, remedy)


@dataclass(frozen=True, eq=False)
class Image:
    """An exposure.

    Attributes
    ----------
    pixels : array (h, w)
        Grey values, uint8 or uint16; row 0 is the top of the image.
    stamp_ns : int, optional
        Middle of the exposure; None = the middle of the call of `Machine.image`.
    """

    pixels: np.ndarray
    stamp_ns: int | None = None


@dataclass(frozen=True)
class Offset:
    """A mark or a line that the machine's own sensor sees.

    Attributes
    ----------
    x, y : float
        Centre of the mark less the optical axis, stage axes, m.
    theta : float, optional
        Direction of a line less the optical axis, counter-clockwise, rad; None = a mark.
    mark : tuple of int, optional
        (m, n) of the mark on the plate, if the sensor knows it.
    line : int, optional
        Index of the line, if the sensor knows it.
    sigma : float
        Standard uncertainty, m or rad; 0 = unknown.
    score : float
        0 (worst) to 1.
    stamp_ns : int, optional
        Middle of the exposure; None = the middle of the call of `Machine.offsets`.
    """

    x: float = 0.0
    y: float = 0.0
    theta: float | None = None
    mark: tuple[int, int] | None = None
    line: int | None = None
    sigma: float = 0.0
    score: float = 1.0
    stamp_ns: int | None = None


@dataclass(frozen=True)
class Placing:
    """How the plate is to lie in a view; given to a robot, or to a simulation.

    Attributes
    ----------
    view : str
        Name of the view.
    x, y : float
        Centre of the plate from the centre of the field, stage axes, m.
    rotation : float
        Turn of the plate, counter-clockwise, rad.
    command : object
        The command of the view, with plate and plan, for simulations; not part of the public
        interface.
    """

    view: str
    x: float
    y: float
    rotation: float
    command: Any = None


@runtime_checkable
class Machine(Protocol):
    """A stage and what sees the marks.

    A machine may also have a method ``place(placing)``, which lays the plate down: it is called
    where CELL.yaml has ``placing: robot``.

    Attributes
    ----------
    axes : tuple of str
        ``("x", "y")`` or ``("x", "y", "theta")``: the order of all positions.
    """

    axes: tuple[str, ...]

    def position(self) -> tuple[float, ...]:
        """Return the indicated position now, m and rad.

        Raises
        ------
        MachineError
            If it cannot be read.
        """
        ...

    def move_to(self, position: tuple[float, ...]) -> None:
        """Move all axes, and return when the commanded motion has ended.

        Limits are checked before the call, rest is verified after it from `position`.

        Raises
        ------
        MachineError
            If the machine refuses, or does not arrive.
        """
        ...

    def image(self) -> Image | None:
        """Expose now and return the image; None if the machine detects marks by itself."""
        ...

    def offsets(self) -> list[Offset]:
        """Return the marks and lines seen now; called where `image` returns None."""
        ...

    def stop(self) -> None:
        """Stop all motion at once; may be called from another thread while `move_to` runs."""
        ...

    def close(self) -> None:
        """Release the machine."""
        ...
