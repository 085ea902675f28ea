# SPDX-License-Identifier: Apache-2.0
"""For every test: the same examples in every run, no clock, one thread of linear algebra.

Two workers with two threads each would wait for one another in matrices of a few hundred rows.
The number is set before NumPy is loaded; processes that tests start inherit it.
"""

import gc
import os

from hypothesis import given, settings, strategies

for _libraries in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_libraries, "1")

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
gc.disable()  # nothing that is collected goes before the tests do

RARELY = (100_000, 50, 100)
"""Objects and rounds between two looks for garbage: tests leave little in circles."""


@given(strategies.none())
def first_example(nothing: None) -> None:
    """Have Hypothesis ask once, before the freeze, what holds the generators of random numbers.

    Older versions ask the garbage collector, which does not know what is frozen, and warn.
    """


def pytest_collection_finish():
    """Look for garbage again, but no more through modules and tests."""
    first_example()
    gc.collect()
    gc.freeze()
    gc.set_threshold(*RARELY)
    gc.enable()
