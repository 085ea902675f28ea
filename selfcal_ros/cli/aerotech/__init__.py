# SPDX-License-Identifier: Apache-2.0
"""The sub-verbs of ``selfcal cal``: files of Aerotech controllers."""
