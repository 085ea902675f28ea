# SPDX-License-Identifier: Apache-2.0
"""What was found, in sentences for people: estimation gives it as data in SI units."""
