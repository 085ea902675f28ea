# SPDX-License-Identifier: Apache-2.0
"""Hypothesis for every test: the same examples in every run, and no clock on a shared machine."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
