# SPDX-License-Identifier: Apache-2.0
"""Pictures of an error map: plots, and geometry for RViz."""
