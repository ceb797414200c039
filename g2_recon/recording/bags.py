# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""Bags in and out: rosbag2 (MCAP and SQLite) and ROS 1."""

from __future__ import annotations

from g2_recon.recording.bag_access import BAG_ENDINGS, RecordedMessage, RecordedQos, messages
from g2_recon.recording.bag_messages import TILT_JOINT
from g2_recon.recording.bag_reading import read_bag
from g2_recon.recording.bag_writing import write_bag, write_ros1_bag

__all__ = [
    "BAG_ENDINGS",
    "TILT_JOINT",
    "RecordedMessage",
    "RecordedQos",
    "messages",
    "read_bag",
    "write_bag",
    "write_ros1_bag",
]
