# SPDX-License-Identifier: Apache-2.0
"""The machine ``micromanager``: XY stages and cameras that Micro-Manager's core drives.

pymmcore (LGPL) is loaded where it is installed and not shipped. The core has um and ms, no limits
and no time stamps; the position is that which is read back, not the commanded one.
"""

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.errors import first_line
from selfcal_ros.machine.calling import called, stopping_on_error
from selfcal_ros.machine.interface import Image, MachineError, Offset
from selfcal_ros.machine.video import grey
from selfcal_ros.units import M_PER_UM, MS_PER_S, UM_PER_M

ALLOWANCE = 2.0
"""Longest time of a move over that at the speed of the stage."""
PATIENCE_S = 5.0
"""The same for its acceleration."""
TRANSPOSED = ("TransposeMirrorX", "TransposeMirrorY")
"""Properties of a stage that turn the sign of its position."""


class MicroManagerMachine:
    """The XY stage and the camera of a configuration.

    Parameters
    ----------
    config : str
        Configuration file (.cfg) of Micro-Manager.
    adapters : str, optional
        Folder of the device adapters; empty = that of ``mm_test_adapters``, if it is installed.
    speed : float, optional
        Slowest speed of the stage, m/s: a move that takes twice as long has failed.
    exposure : float, optional
        Exposure time, s; 0 = that of the configuration.
    folder : str, optional
        Folder in which a relative `config` begins.
    core : object, optional
        A core that is loaded already, instead of pymmcore's own.

    Raises
    ------
    MachineError
        If the configuration cannot be loaded, or has no XY stage or camera.
    """

    axes = ("x", "y")

    def __init__(
        self,
        config: str,
        adapters: str = "",
        speed: float = 1e-3,
        exposure: float = 0.0,
        folder: str = "",
        core: Any = None,
    ) -> None:
        self._speed = speed
        self._core = core or _new_core()
        self._where = str(config)
        try:
            self._load(adapters or _test_adapters(), config, folder)
            self._stage = self._core.getXYStageDevice()
            for name, device in (
                ("XY stage", self._stage),
                ("camera", self._core.getCameraDevice()),
            ):
                if not device:
                    raise MachineError(
                        f"it has no {name}",
                        self._where,
                        f"name one under Core in the configuration ({name})",
                    )
            if exposure:
                self._expose_for(exposure)
            self._signs = self._transposed()
        except BaseException:
            self._reset()
            raise

    def _load(self, adapters: str, config: str, folder: str) -> None:
        path = Path(folder, config)
        if not path.is_file():
            raise MachineError(
                "there is no such file", str(path), "name the .cfg of the device"
            )
        try:
            if adapters:
                self._core.setDeviceAdapterSearchPaths([adapters])
            self._core.loadSystemConfiguration(str(path))
        except Exception as error:
            raise MachineError(
                f"cannot be loaded ({first_line(error)})",
                str(path),
                "load it in Micro-Manager first; check adapters and cables",
            ) from error

    def _expose_for(self, exposure_s: float) -> None:
        """Set the exposure; a core clips it without a word."""
        self._call("exposure", self._core.setExposure, exposure_s * MS_PER_S)
        set_s = self._core.getExposure() / MS_PER_S
        if not math.isclose(set_s, exposure_s, rel_tol=1e-3):
            raise MachineError(
                f"the exposure is {set_s:g} s instead of {exposure_s:g} s",
                f"{self._where}: exposure",
                "give one that the camera has",
            )

    def _transposed(self) -> tuple[str, ...]:
        return tuple(
            self._core.getProperty(self._stage, name)
            for name in TRANSPOSED
            if self._core.hasProperty(self._stage, name)
        )

    def _call(self, action: str, function: Any, *values: Any) -> Any:
        """Call the core; its errors become those of a machine."""
        return called(
            f"{self._where}: {action}",
            function,
            *values,
            remedy="check the device and its cables",
        )

    def position(self) -> tuple[float, ...]:
        """Return the position read back from the stage, m."""
        x, y = self._call("the position", self._core.getXYPosition, self._stage)
        return x * M_PER_UM, y * M_PER_UM

    def move_to(self, position: tuple[float, ...]) -> None:
        """Move, and wait for the end; a stage that does not arrive in time is stopped."""
        if self._transposed() != self._signs:
            raise MachineError(
                f"{' or '.join(TRANSPOSED)} was changed during the run",
                self._stage,
                "begin anew: the position has another sign",
            )
        x, y = position
        start = self.position()
        longest_s = (
            ALLOWANCE * math.hypot(x - start[0], y - start[1]) / self._speed
            + PATIENCE_S
        )
        self._call("the time-out", self._core.setTimeoutMs, round(longest_s * MS_PER_S))
        self._call(
            "the move",
            self._core.setXYPosition,
            self._stage,
            x * UM_PER_M,
            y * UM_PER_M,
        )
        with stopping_on_error(self.stop):
            self._call("the move", self._core.waitForDevice, self._stage)

    def image(self) -> Image:
        """Expose and return the image; the caller stamps the middle of the call."""
        self._call("the exposure", self._core.snapImage)
        pixels = np.asarray(self._call("the image", self._core.getImage))
        if pixels.dtype == np.uint32:  # four bytes of colour each
            pixels = pixels.view(np.uint8).reshape(*pixels.shape, 4)
        return Image(grey(pixels))

    def offsets(self) -> list[Offset]:
        """Return nothing: marks are found in images."""
        return []

    def stop(self) -> None:
        """Stop the stage; raises MachineError if the core cannot."""
        self._call("the stop", self._core.stop, self._stage)

    def close(self) -> None:
        """Unload all devices: a process that ends without dies of a signal."""
        self._reset()

    def _reset(self) -> None:
        with contextlib.suppress(Exception):
            self._core.reset()


def _new_core() -> Any:
    import pymmcore  # extra micromanager

    return pymmcore.CMMCore()


def _test_adapters() -> str:
    """Return the folder of the demo devices; empty if they are not installed."""
    try:
        import mm_test_adapters  # the demo devices, for tests
    except ModuleNotFoundError:
        return ""
    return str(mm_test_adapters.device_adapter_path())
