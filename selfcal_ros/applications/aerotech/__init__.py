# SPDX-License-Identifier: Apache-2.0
"""Aerotech .cal files: read, check, evaluate, write, export from a map and verify."""
