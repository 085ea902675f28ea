# SPDX-License-Identifier: Apache-2.0
"""Joint least squares of all readings, and the noise."""
