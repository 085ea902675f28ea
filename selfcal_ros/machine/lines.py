# SPDX-License-Identifier: Apache-2.0
"""Lines to and from a controller over a serial port or TCP."""

import time
from typing import Any

from selfcal_ros.machine.interface import MachineError

LONGEST = 4096
"""Longest line of a controller, characters."""


class Lines:
    """A connection that speaks in lines.

    Parameters
    ----------
    port : str
        Serial port, or ``socket://host:port`` (or any other URL of pyserial).
    baud : int
        Rate of a serial port.
    timeout_s : float
        Longest wait for a line.

    Raises
    ------
    MachineError
        If the port cannot be opened.
    """

    def __init__(self, port: str, baud: int, timeout_s: float) -> None:
        import serial  # extra gcode

        self._port, self._baud, self._timeout_s = port, baud, timeout_s
        self._lost = (serial.SerialException, OSError)
        try:
            self._serial: Any = serial.serial_for_url(port, baudrate=baud, timeout=0.1)
        except (serial.SerialException, OSError, ValueError) as error:
            raise MachineError(
                f"the port cannot be opened ({error})",
                port,
                "check name, cable and permissions (group dialout)",
            ) from error

    def again(self) -> "Lines":
        """Return another connection to the same controller; raises like the first."""
        return Lines(self._port, self._baud, self._timeout_s)

    def send(self, line: str) -> None:
        """Send a line."""
        self.send_raw(line.encode("ascii") + b"\n")

    def send_raw(self, data: bytes) -> None:
        """Send bytes at once, as the real-time commands of GRBL."""
        try:
            self._serial.write(data)
            self._serial.flush()
        except self._lost as error:
            raise self._lost_connection(error) from error

    def receive(self, timeout_s: float | None = None) -> str:
        """Return the next line that is not empty.

        Raises
        ------
        MachineError
            If the connection is lost, or there is no line in time.
        """
        wait_s = self._timeout_s if timeout_s is None else timeout_s
        deadline = time.monotonic() + wait_s
        data = b""
        while time.monotonic() < deadline:
            try:
                data += self._serial.readline(LONGEST)
            except self._lost as error:
                raise self._lost_connection(error) from error
            if data.endswith((b"\n", b"\r")) and data.strip():
                return data.decode("ascii", "replace").strip()
            if not data.strip():
                data = b""
        raise MachineError(
            f"no answer in {wait_s:.3g} s",
            self._port,
            "check baud, dialect and the emergency stop",
        )

    def forget(self) -> None:
        """Drop what has been received and not read."""
        try:
            self._serial.reset_input_buffer()
        except self._lost as error:
            raise self._lost_connection(error) from error

    def close(self) -> None:
        """Close the port."""
        self._serial.close()

    def _lost_connection(self, error: Exception) -> MachineError:
        return MachineError(
            f"the connection was lost ({error})",
            self._port,
            "check cable and power; then --resume continues",
        )
