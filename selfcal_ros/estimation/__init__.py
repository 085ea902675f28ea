# SPDX-License-Identifier: Apache-2.0
"""Estimators: from readings to maps with uncertainties; one sub-package per question."""
