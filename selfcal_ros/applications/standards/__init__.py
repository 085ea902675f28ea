# SPDX-License-Identifier: Apache-2.0
"""Guest: results in the terms of standards: digital calibration certificates, ISO 230."""
