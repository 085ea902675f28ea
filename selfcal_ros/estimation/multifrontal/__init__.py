# SPDX-License-Identifier: Apache-2.0
"""How the sites' equations of a large field are factorised exactly and fast."""
