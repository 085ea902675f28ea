# SPDX-License-Identifier: Apache-2.0
"""MCAP files as a stream of messages, whatever happened to them."""
