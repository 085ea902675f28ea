# SPDX-License-Identifier: Apache-2.0
"""Between messages and the model, and the names of topics, without any middleware."""
