# SPDX-License-Identifier: Apache-2.0
"""Step-diagonal laser measurement: readings, identification, simulation."""
