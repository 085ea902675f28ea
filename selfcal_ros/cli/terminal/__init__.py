# SPDX-License-Identifier: Apache-2.0
"""What verbs write to the terminal: progress, and a result."""
