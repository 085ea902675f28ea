# SPDX-License-Identifier: Apache-2.0
"""Where each mark of a view lies on the stage, and which sites hang together."""
