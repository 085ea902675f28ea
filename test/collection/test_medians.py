# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.collection.marks.medians import distances, median, row_medians


@pytest.mark.parametrize("count", [1, 2, 3, 4, 12, 13, 100, 101])
@pytest.mark.parametrize("of", [1.0, 1e-9, 3e5])
def test_medians_are_those_of_numpy_to_the_bit(count, of):
    rng = np.random.default_rng(count)
    table = rng.normal(of, of, (20, 3, count))
    table[rng.random(table.shape) < 0.3] = of  # ties
    for row in table[:, 0]:
        before = row.copy()
        assert median(row) == np.median(row)
        np.testing.assert_array_equal(row, before)  # untouched unless it may be
        assert median(row, overwrite=True) == np.median(before)
    rest = table[:, 1:]
    np.testing.assert_array_equal(row_medians(rest), np.median(rest, axis=-1, keepdims=True))


def test_distances():
    np.testing.assert_array_equal(distances(np.array([[3e-9, -5.0, 0.0], [4e-9, 12.0, 0.0]])),
                                  [5e-9, 13.0, 0.0])
