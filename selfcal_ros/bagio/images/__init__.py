# SPDX-License-Identifier: Apache-2.0
"""Images in bags and in folders of files, and bags of their detections."""
