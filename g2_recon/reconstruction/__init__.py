# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""From a cloud to a mesh, in the four phases of the paper."""
