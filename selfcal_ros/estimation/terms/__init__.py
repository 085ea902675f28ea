# SPDX-License-Identifier: Apache-2.0
"""What else is in the readings: microscope, drift, plate scale and shape, direction of approach."""
