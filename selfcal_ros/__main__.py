# SPDX-License-Identifier: Apache-2.0
"""Entry point of ``python -m selfcal_ros``."""

import sys

from selfcal_ros.start import selfcal

sys.exit(selfcal())
