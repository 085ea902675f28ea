# SPDX-License-Identifier: Apache-2.0
"""Checks of the cell's set-up, before any map is computed."""
