# SPDX-License-Identifier: Apache-2.0
"""Messages of rclpy from plain nested dicts, and back to what sessions understand."""

import array
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from selfcal_ros.sessions.ports import Diagnosis, Level


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Return an rclpy message with its fields set from a plain nested dict."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            current = getattr(message, name)
            if isinstance(current, array.array):
                value = array.array(current.typecode, value.tolist())
            setattr(message, name, value)
        else:
            setattr(message, name, value)
    return message


def diagnosis_of(status: DiagnosticStatus) -> Diagnosis:
    """Return the diagnosis in a status message; an unknown level counts as ERROR."""
    level = status.level[0]
    return Diagnosis(Level(level) if level in list(Level) else Level.ERROR, status.message,
                     {item.key: item.value for item in status.values})
