# SPDX-License-Identifier: Apache-2.0
"""Terms of the model: microscope, drift, plate scale and shape, direction of approach."""
