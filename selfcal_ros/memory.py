# SPDX-License-Identifier: Apache-2.0
"""What the allocator does with memory that is freed."""

import numpy as np

LARGEST_KEPT = 31 * 2**20
"""Bytes of a block that is freed, just below the largest that counts (32 MB)."""


def keep_freed_memory() -> None:
    """Have the allocator keep what is freed, up to 64 MB, instead of giving it back at once.

    A solution takes and frees some hundred arrays of 0.1 to 1 MB, a collector 1.5 MB for each
    65,536 samples of a joint. Each page that comes from the system anew costs 2 to 5 us: a tenth of
    a solution, a fifth of a status of many samples. The allocator of glibc takes what is freed as
    the measure of what to keep (mallopt(3), M_MMAP_THRESHOLD: "adjusted dynamically"); nothing is
    written to the block, so it takes no memory. Other allocators are not impressed.
    """
    np.empty(LARGEST_KEPT, dtype=np.uint8)
