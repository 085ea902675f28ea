# SPDX-License-Identifier: Apache-2.0
"""Where the stage was at the instants of exposure, from the encoder."""
