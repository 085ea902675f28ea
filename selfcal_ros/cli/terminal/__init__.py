# SPDX-License-Identifier: Apache-2.0
"""Terminal output of the verbs: progress, and a result."""
