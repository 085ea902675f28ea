# SPDX-License-Identifier: Apache-2.0
"""Where the stage was at each exposure, whether it rested, and from where it had come."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.encoder import JointTrack


@dataclass(frozen=True)
class Tracks:
    """Encoder samples of the three joints."""

    x: JointTrack
    y: JointTrack
    theta: JointTrack


@dataclass(frozen=True)
class JointAt:
    """One joint at each exposure: arrays (Q,).

    Attributes
    ----------
    position : float array
        Indicated position, m or rad; NaN where there is none.
    reason : object array
        Why the position cannot be used; None where it can.
    moving : object array
        `Reason.MOVING` where the joint is known to move, for readings that do not need it.
    """

    position: np.ndarray
    reason: np.ndarray
    moving: np.ndarray

    def at(self, index: np.ndarray) -> "JointAt":
        """Return the rows `index`."""
        return JointAt(self.position[index], self.reason[index], self.moving[index])


@dataclass(frozen=True)
class Exposures:
    """The stage at each instant of exposure; stamps rise, each once.

    `approach` (2, Q) holds the signs of the last motions of x and y (`JointTrack.approach`).
    """

    stamps_ns: np.ndarray
    x: JointAt
    y: JointAt
    theta: JointAt
    approach: np.ndarray

    def at(self, stamps_ns: np.ndarray) -> "Exposures":
        """Return the rows of some of the instants, in the order that is asked for."""
        index = np.searchsorted(self.stamps_ns, stamps_ns)
        return Exposures(stamps_ns, self.x.at(index), self.y.at(index), self.theta.at(index),
                         self.approach[:, index])


def look_up(tracks: Tracks, stamps_ns: np.ndarray, *, approach_threshold_m: float) -> Exposures:
    """Return the stage at each of the instants of exposure of a session.

    Parameters
    ----------
    tracks : Tracks
        Encoder samples.
    stamps_ns : int64 array (n,)
        Instants of all detections, in any order.
    approach_threshold_m : float
        Smallest displacement that counts as a motion of x or y.
    """
    stamps = np.unique(stamps_ns)
    joints = [JointAt(*track.query(stamps), track.moving(stamps))
              for track in (tracks.x, tracks.y, tracks.theta)]
    approach = [track.approach(stamps, joint.position, threshold=approach_threshold_m)
                for track, joint in zip((tracks.x, tracks.y), joints, strict=False)]
    return Exposures(stamps, *joints, np.stack(approach))
