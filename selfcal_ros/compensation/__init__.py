# SPDX-License-Identifier: Apache-2.0
"""Use of an error map: evaluation and inversion."""
