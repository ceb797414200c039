# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes: thin wrappers over the stages; the only place that knows ROS."""
