# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The ways of the robot through the first floor: legs of way-points x, y in metres in the building frame."""

from __future__ import annotations

FULL_TOUR = (
    # corridor, study
    ((5.40, 1.00), (5.40, 3.05), (2.10, 3.05)),
    # corridor, round the laboratory, end of the corridor
    (
        *((2.10, 3.05), (5.40, 3.05), (5.40, 9.75), (3.00, 9.75), (3.00, 12.10), (1.60, 12.10)),
        *((1.60, 7.70), (3.00, 7.70), (3.00, 9.75), (5.40, 9.75), (5.40, 11.30)),
    ),
    # corridor, hall, seminar room, corridor, first toilet
    (
        *((5.40, 11.30), (5.40, 6.90), (8.65, 6.90), (8.65, 12.65), (19.20, 12.65)),
        *((19.20, 9.00), (16.05, 9.00), (16.05, 6.90), (19.00, 6.90), (19.00, 4.40)),
    ),
    # second toilet
    ((19.00, 4.40), (19.00, 6.90), (16.90, 6.90), (16.90, 4.40)),
    # corridor, workshop, office, and back
    (
        *((16.90, 4.40), (16.90, 6.90), (13.65, 6.90), (13.65, 2.05)),
        *((8.00, 2.05), (8.00, 6.90), (5.40, 6.90), (5.40, 4.20)),
    ),
)
"""Through every room and back; the robot turns in place between the legs."""

SWEEP_TOUR = (
    ((5.40, 5.00), (5.40, 7.00)),
    ((5.40, 7.00), (5.40, 9.75)),
    ((5.40, 9.75), (5.40, 6.90), (7.00, 6.90)),
    ((7.00, 6.90), (8.65, 6.90), (8.65, 9.60)),
    ((8.65, 9.60), (8.65, 12.65), (11.00, 12.65)),
)
"""From the corridor into the hall; the robot stops between the legs, and before and after them, for a sweep."""
