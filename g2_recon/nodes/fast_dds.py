# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""How Fast DDS, which ROS 2 takes if nothing else is asked for, serves nodes that come late and send large messages.

With what it does by itself, each place in a queue keeps the memory of the largest message that it ever held: a node
that once sent fifty pieces of a cloud within three seconds keeps the memory of them for good. And a process that was
there before may find a new one only after three seconds, when that announces itself again.
"""

from __future__ import annotations

import os
from pathlib import Path

PROFILE = Path(__file__).with_name("fast_dds.xml")
_FILES = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
_QOS_FROM_FILE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
# Whoever has set one of these, or has one of these files where the node runs, has a wish of their own.
_WISHES = *_FILES, _QOS_FROM_FILE, "RMW_FASTRTPS_PUBLICATION_MODE"
_FILES_HERE = "DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml"


def use_profile() -> bool:
    """Have Fast DDS take its profile from the file beside this one, unless the user wants another; whether it does.

    To be called before the first rclpy.init of a process, as Fast DDS reads the file once.
    """
    if any(name in os.environ for name in _WISHES) or any(Path(name).exists() for name in _FILES_HERE):
        return False
    os.environ |= dict.fromkeys(_FILES, str(PROFILE)) | {_QOS_FROM_FILE: "1"}
    return True
