# SPDX-License-Identifier: Apache-2.0
"""The machine ``ophyd``: motors and detectors of ophyd, as laboratories drive them (EPICS, ...)."""

import importlib
import inspect
import math
from functools import partial, reduce
from typing import Any

import numpy as np

from selfcal_ros.errors import first_line
from selfcal_ros.machine.calling import called, stopping_on_error
from selfcal_ros.machine.interface import Image, MachineError, Offset
from selfcal_ros.machine.video import grey
from selfcal_ros.units import M_PER, RAD_PER

UNITS: dict[str, str] = {unit: unit for unit in (*M_PER, *RAD_PER)} | {
    "µm": "um",
    "micron": "um",
    "micrometer": "um",
    "millimeter": "mm",
    "degree": "deg",
    "radian": "rad",
}
"""What motors call their unit, in lower case and without a plural -> its name here."""

_called = partial(called, remedy="check limits, connection and the alarm of the axis")


class OphydMachine:
    """Positioners for the axes, and a detector that shows images.

    Parameters
    ----------
    x, y : str
        Positioners, each as ``module:object``.
    theta : str, optional
        Positioner of the rotary axis.
    unit : str, optional
        Unit of x and y: m, mm, um or nm.
    angle_unit : str, optional
        Unit of theta: deg, rad, mrad, urad or arcsec.
    detector : str, optional
        Detector, ``module:object``: it is triggered for every image.
    image : str, optional
        What has the image below the detector: names joined by dots, of a signal or a property.
    timeout : float, optional
        Longest time of a move or an exposure, s.

    Raises
    ------
    MachineError
        If an object cannot be had or is not connected.
    """

    def __init__(
        self,
        x: str,
        y: str,
        theta: str = "",
        unit: str = "mm",
        angle_unit: str = "deg",
        detector: str = "",
        image: str = "image",
        timeout: float = 60.0,
    ) -> None:
        if unit not in M_PER:
            raise MachineError(
                f"the unit '{unit}' is unknown",
                "ophyd: unit",
                f"use {', '.join(M_PER)}",
            )
        if angle_unit not in RAD_PER:
            raise MachineError(
                f"the unit '{angle_unit}' is unknown",
                "ophyd: angle_unit",
                f"use {', '.join(RAD_PER)}",
            )
        names = {"x": x, "y": y} | ({"theta": theta} if theta else {})
        self.axes = tuple(names)
        self._per_unit = {
            axis: RAD_PER[angle_unit] if axis == "theta" else M_PER[unit]
            for axis in names
        }
        self._timeout_s, self._image = timeout, image
        self._motors = {axis: _object(name, timeout) for axis, name in names.items()}
        for axis, motor in self._motors.items():
            _require_unit(axis, motor, angle_unit if axis == "theta" else unit)
        self._detector = _object(detector, timeout) if detector else None

    def position(self) -> tuple[float, ...]:
        """Return the positions that the motors read back, m and rad."""
        values = []
        for axis, motor in self._motors.items():
            value = _called(f"position of {axis}", _present_position, motor)
            if value is None or not math.isfinite(float(value)):
                raise MachineError(
                    f"its position is {value}", axis, "check its connection"
                )
            values.append(float(value) * self._per_unit[axis])
        return tuple(values)

    def move_to(self, position: tuple[float, ...]) -> None:
        """Start all axes, and wait for all."""
        with stopping_on_error(self.stop):
            waiting = [
                (
                    axis,
                    _called(axis, self._motors[axis].set, value / self._per_unit[axis]),
                )
                for axis, value in zip(self.axes, position, strict=True)
            ]
            for axis, status in waiting:
                _called(axis, status.wait, timeout=self._timeout_s)

    def image(self) -> Image | None:
        """Trigger the detector and return its image; None without one."""
        if self._detector is None:
            return None
        status = _called("trigger", self._detector.trigger)
        _called("trigger", status.wait, timeout=self._timeout_s)
        signal = reduce(getattr, self._image.split("."), self._detector)
        pixels = np.asarray(
            _called("image", signal.get) if hasattr(signal, "get") else signal
        )
        return Image(grey(pixels))

    def offsets(self) -> list[Offset]:
        """Return nothing: without a detector nothing is seen."""
        return []

    def stop(self) -> None:
        """Stop all axes; raises MachineError of the first that cannot be, or does not answer."""
        failed: list[MachineError] = []
        for act in (_stop, _present_position):
            for axis, motor in self._motors.items():
                try:
                    _called(axis, act, motor)
                except MachineError as error:
                    failed.append(error)
        if failed:
            raise failed[0]

    def close(self) -> None:
        """Do nothing: the objects belong to their module."""


def _stop(motor: Any) -> None:
    """Stop a positioner, if it can be; an EPICS motor does not wait for the answer."""
    if hasattr(motor, "stop"):
        motor.stop()


def _present_position(motor: Any) -> Any:
    """Return the position of a positioner, asked for now.

    `position` of EPICS is what its monitor told last: an old one, if the server hangs, or within
    the deadband of the monitor (MDEL).
    """
    for name in ("user_readback", "readback"):
        get = getattr(getattr(motor, name, None), "get", None)
        if get and "use_monitor" in inspect.signature(get).parameters:
            return get(use_monitor=False)
    return motor.position


def _require_unit(axis: str, motor: Any, stated: str) -> None:
    """Raise if a positioner says that it counts in another unit: EGU of a motor record."""
    egu = _called(f"unit of {axis}", lambda: getattr(motor, "egu", ""))
    says = str(egu).strip()
    unit = UNITS.get(says.lower().removesuffix("s"))
    if unit not in (None, stated):
        raise MachineError(
            f"its motor counts in {says}, stated is {stated}",
            axis,
            "correct unit or angle_unit below ophyd",
        )


def _object(name: str, timeout_s: float) -> Any:
    """Return an object named ``module:object``, connected."""
    module, _, path = name.partition(":")
    try:
        device = reduce(getattr, path.split("."), importlib.import_module(module))
    except (ImportError, AttributeError, ValueError) as error:
        raise MachineError(
            f"'{name}' cannot be had ({first_line(error)})",
            "ophyd",
            "name module:object; the module may lie beside CELL.yaml",
        ) from error
    if hasattr(device, "wait_for_connection"):
        _called(name, device.wait_for_connection, timeout=timeout_s)
    return device
