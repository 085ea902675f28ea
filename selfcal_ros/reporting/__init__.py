# SPDX-License-Identifier: Apache-2.0
"""Plots, tables and reports: the only place that imports matplotlib."""

import logging

# that a HOME cannot be written is no fault of a picture
logging.getLogger("matplotlib").addFilter(
    lambda record: record.levelno >= logging.ERROR
)
