# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Files in and out: bags, CARMEN logs, trajectories, clouds, meshes."""
