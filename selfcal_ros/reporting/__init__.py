# SPDX-License-Identifier: Apache-2.0
"""Plots, tables and reports: the only place that imports matplotlib."""
