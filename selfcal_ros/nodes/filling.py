# SPDX-License-Identifier: Apache-2.0
"""Messages of rclpy from plain nested dicts, and back to the types of sessions."""

import array
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from selfcal_ros.errors import printable
from selfcal_ros.sessions.ports import Diagnosis, Level


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Return an rclpy message with its fields set from a plain nested dict."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            current = getattr(message, name)
            if isinstance(current, array.array):
                code = current.typecode
                fits = np.can_cast(value.dtype, code)  # otherwise `array` checks each number
                value = array.array(code, value.astype(code).tobytes() if fits else value.tolist())
            setattr(message, name, value)
        else:
            setattr(message, name, value)
    return message


def status_of(diagnosis: Diagnosis, name: str, hardware_id: str) -> DiagnosticStatus:
    """Return the status message of a diagnosis; control characters are made visible."""
    return DiagnosticStatus(
        level=bytes([diagnosis.level]), name=name, message=printable(diagnosis.message),
        hardware_id=printable(hardware_id),
        values=[KeyValue(key=printable(key), value=printable(str(value)))
                for key, value in diagnosis.values.items()])


def diagnosis_of(status: DiagnosticStatus) -> Diagnosis:
    """Return the diagnosis in a status message; an unknown level counts as ERROR."""
    level = status.level[0]
    return Diagnosis(Level(level) if level in list(Level) else Level.ERROR, status.message,
                     {item.key: item.value for item in status.values})
