# SPDX-License-Identifier: Apache-2.0
"""Whether the readings agree with the model behind the uncertainties, and the causes if not."""
