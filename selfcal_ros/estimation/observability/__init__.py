# SPDX-License-Identifier: Apache-2.0
"""Whether a plan determines the stage, how well, and which view would help."""
