# SPDX-License-Identifier: Apache-2.0
"""Tables of other controllers than Aerotech's, and corrected G-code."""
