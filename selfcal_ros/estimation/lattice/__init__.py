# SPDX-License-Identifier: Apache-2.0
"""Site of each mark of a view on the stage, and connected sites."""
