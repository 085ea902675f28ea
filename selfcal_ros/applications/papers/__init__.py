# SPDX-License-Identifier: Apache-2.0
"""The published simulations, rerun with seeds and compared with the printed figures."""
