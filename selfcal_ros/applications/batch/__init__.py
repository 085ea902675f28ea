# SPDX-License-Identifier: Apache-2.0
"""Many bags at once: solved on all cores, stored by content, compared over time."""
