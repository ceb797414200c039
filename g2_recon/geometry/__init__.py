# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What every stage speaks: poses, trajectories, scans, clouds, meshes."""
