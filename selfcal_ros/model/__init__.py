# SPDX-License-Identifier: Apache-2.0
"""The vocabulary: artifact, view, plan, readings, error map, result. No I/O."""
