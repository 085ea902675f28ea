# SPDX-License-Identifier: Apache-2.0
"""A joint whose samples are asked all at once."""

import numpy as np

from selfcal_ros.collection import encoder


class JointTrack(encoder.JointTrack):
    """The collector's track, with the answers of the series of all its samples."""

    def add(self, stamp_ns: int, position: float, speed: float) -> None:
        self.store.add_block(
            np.array([stamp_ns]), np.array([position]), np.array([speed])
        )

    def query(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        positions, codes = self._all().query(stamps_ns)
        return positions, encoder.REASONS[codes]

    def moving(self, stamps_ns: np.ndarray) -> np.ndarray:
        series = self._all()
        moves = series.moving(stamps_ns, series.query(stamps_ns)[1])
        return encoder.REASONS[np.where(moves, encoder.MOVING, encoder.GOOD)]

    def approach(
        self, stamps_ns: np.ndarray, positions: np.ndarray, *, threshold: float
    ) -> np.ndarray:
        return encoder.filled(
            self._all().approach(stamps_ns, positions, threshold=threshold)
        )

    def _all(self) -> encoder.JointSamples:
        return self.between(encoder.NEVER, encoder.EVER)
