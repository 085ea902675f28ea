# SPDX-License-Identifier: Apache-2.0
"""From the bytes that arrive to the session, by way of the journal."""
