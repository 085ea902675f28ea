# SPDX-License-Identifier: Apache-2.0
"""Machines: the interface of a stage with its camera or sensor, and what drives it.

Public, with semantic versioning: `Machine`, `Image`, `Offset`, `Placing` and `MachineError`. A
class of your own needs no more than these (docs/start/machines.md).
"""

from selfcal_ros.machine.interface import Image, Machine, MachineError, Offset, Placing

__all__ = ["Image", "Machine", "MachineError", "Offset", "Placing"]
