# SPDX-License-Identifier: Apache-2.0
"""Which maps fit all readings best, and how large the noise is."""
