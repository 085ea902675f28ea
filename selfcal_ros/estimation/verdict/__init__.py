# SPDX-License-Identifier: Apache-2.0
"""Do the readings agree with the model that the uncertainties assume, and if not, why not."""
