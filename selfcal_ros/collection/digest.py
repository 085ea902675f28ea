# SPDX-License-Identifier: Apache-2.0
"""A fingerprint of readings: equal digests mean equal readings, to the last bit."""

import hashlib

import numpy as np

from selfcal_ros.model.readings import ViewReadings

_ARRAYS = (("m", "i8"), ("n", "i8"), ("dx", "f8"), ("dy", "f8"), ("count", "i8"), ("u", "f8"),
           ("k", "i8"), ("dtheta", "f8"), ("count_theta", "i8"), ("u_theta", "f8"))


def readings_digest(readings: ViewReadings, rejected: dict[str, int]) -> str:
    """Return the SHA-256 of one view's readings and of the rejections outside of views."""
    digest = hashlib.sha256()
    for name, kind in _ARRAYS:
        digest.update(np.ascontiguousarray(getattr(readings, name), dtype=kind).tobytes())
    digest.update(repr((readings.view, readings.sigma_xy, readings.sigma_theta, readings.dof_xy,
                        readings.dof_theta, readings.used, readings.rejected,
                        dict(sorted(rejected.items())))).encode())
    return digest.hexdigest()


def session_digest(digests: dict[int, str]) -> str:
    """Return one digest of view_index -> digest."""
    return hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()[:16]
