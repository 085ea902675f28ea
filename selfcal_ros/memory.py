# SPDX-License-Identifier: Apache-2.0
"""Policy of the allocator for freed memory."""

import numpy as np

LARGEST_KEPT = 31 * 2**20
"""Size of a freed block, just below the largest that has an effect (32 MB)."""


def keep_freed_memory() -> None:
    """Have the allocator keep freed memory, up to 64 MB, instead of returning it at once.

    A solution takes and frees some hundred arrays of 0.1 to 1 MB, a collector 1.5 MB for each
    65,536 samples of a joint. Each page from the system costs 2 to 5 us: a tenth of
    a solution, a fifth of a status of many samples. The allocator of glibc adapts its threshold to
    freed blocks (mallopt(3), M_MMAP_THRESHOLD: "adjusted dynamically"); nothing is
    written to the block, so it takes no memory. Other allocators are not affected.
    """
    np.empty(LARGEST_KEPT, dtype=np.uint8)
