# SPDX-License-Identifier: Apache-2.0
"""Aerotech .cal files: read, check, evaluate, write, made from a map, verified against it."""
