# SPDX-License-Identifier: Apache-2.0
"""Which mark was seen, and what its repeats and visits give."""
