# SPDX-License-Identifier: Apache-2.0
"""Recheck: the map of a stage from views of a plate that is known, and what has changed."""
