# SPDX-License-Identifier: Apache-2.0
"""A fingerprint of readings: equal digests mean equal readings, to the last bit."""

import hashlib
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View

_ARRAYS = (("m", "i8"), ("n", "i8"), ("dx", "f8"), ("dy", "f8"), ("count", "i8"), ("u", "f8"),
           ("k", "i8"), ("dtheta", "f8"), ("count_theta", "i8"), ("u_theta", "f8"))
_VISITS = (("mark", "i8"), ("dx", "f8"), ("dy", "f8"), ("count", "i8"), ("stamp_ns", "i8"),
           ("offset_x", "f8"), ("offset_y", "f8"), ("approach_x", "i1"), ("approach_y", "i1"),
           ("u", "f8"))


def readings_digest(readings: ViewReadings, rejected: dict[str, int]) -> str:
    """Return the SHA-256 of one view's readings, visits, and the rejections outside of views."""
    if readings not in _KNOWN:
        _KNOWN[readings] = _digest(readings)
    return hashlib.sha256(repr((_KNOWN[readings], sorted(rejected.items()))).encode()).hexdigest()


_KNOWN: WeakKeyDictionary[ViewReadings, str] = WeakKeyDictionary()
"""Digests of readings that are still in use: those of a view that is over are asked for again."""


def _digest(readings: ViewReadings) -> str:
    digest, visits = hashlib.sha256(), readings.visits
    for table, columns in ((readings, _ARRAYS), *(((visits, _VISITS),) if visits else ())):
        for name, kind in columns:
            digest.update(np.ascontiguousarray(getattr(table, name), dtype=kind).tobytes())
    if visits:
        digest.update(repr((visits.sigma_m, visits.dof)).encode())
    for motion in (readings.motion, readings.motion_theta):
        if motion:
            digest.update(motion.products.tobytes() + repr(motion.dof).encode())
    # what was read, not how it was to be measured
    view = replace(readings.view, visit_order="", check_marks=0, check_offset_m=0.0)
    digest.update(repr((view, readings.sigma_xy, readings.sigma_theta, readings.dof_xy,
                        readings.dof_theta, readings.used, readings.rejected)).encode())
    return digest.hexdigest()


def placing_digest(artifact: Artifact, view: View) -> str:
    """Return a short digest of a plate and of how a view lays and reads it, names left out."""
    numbers = (*artifact.shape, artifact.grid_pitch_m, artifact.angular_count, view.rotation_rad,
               *view.translation_m, view.grid, view.angular, view.repeats,
               view.check_marks, view.check_offset_m)
    text = ",".join(float(number).hex() for number in numbers)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def session_digest(digests: dict[int, str]) -> str:
    """Return one digest of view_index -> digest."""
    return hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()[:16]
