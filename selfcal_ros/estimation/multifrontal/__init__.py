# SPDX-License-Identifier: Apache-2.0
"""Exact and fast factorisation of the sites' equations of a large field."""
