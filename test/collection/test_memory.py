# SPDX-License-Identifier: Apache-2.0
"""Freed memory is kept: arrays that are made again and again take no new pages."""

import subprocess
import sys

import pytest

PAGES_OF = """
import resource
import numpy as np
from selfcal_ros.collection.collector import keep_freed_memory

def pages():
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        arrays = [np.ones(2**17) for _ in range(12)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = pages()
keep_freed_memory()
print(first, pages())
"""


def test_arrays_made_again_take_no_new_pages():
    done = subprocess.run(
        [sys.executable, "-c", PAGES_OF], capture_output=True, text=True, check=True
    )
    without, kept = map(int, done.stdout.split())
    if without < 1000:
        pytest.skip("this allocator keeps what is freed by itself")
    assert kept < 100
