# SPDX-License-Identifier: Apache-2.0
"""What the clocks of a session do."""
