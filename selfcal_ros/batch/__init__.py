# SPDX-License-Identifier: Apache-2.0
"""Many bags at once: solved on all cores, kept by what they hold, compared over time."""
