# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot with LMS200 lasers in a simulated building, with exact truth."""
