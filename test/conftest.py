# SPDX-License-Identifier: Apache-2.0
"""For every test: the same examples in every run, no clock, one thread of linear algebra.

Two workers with two threads each would wait for one another in matrices of a few hundred rows.
The number is set before NumPy is loaded; processes that tests start inherit it.
"""

import gc
import os

from hypothesis import settings

for _libraries in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_libraries, "1")

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
gc.disable()  # nothing that is collected goes before the tests do


def pytest_collection_finish():
    """Look for garbage again, but no more through modules and tests."""
    gc.collect()
    gc.freeze()
    gc.enable()
