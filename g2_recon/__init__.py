# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""From the laser scans of a mobile robot to a mesh of the building it drove through."""

__version__ = "0.1.0"
