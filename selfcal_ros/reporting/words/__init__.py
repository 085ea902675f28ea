# SPDX-License-Identifier: Apache-2.0
"""Sentences and tables for people from findings, budgets and validations (SI units)."""
