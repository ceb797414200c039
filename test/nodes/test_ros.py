# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import os
import sys
import threading

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from g2_recon.nodes.ros import yield_processor


def policy():
    return os.sched_getscheduler(threading.get_native_id())


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no policy of their own elsewhere")
def test_a_thread_that_yields_takes_the_threads_that_it_starts_with_it_and_no_others():
    seen = []

    def work():
        yield_processor()
        seen.append(policy())
        child = threading.Thread(target=lambda: seen.append(policy()))
        child.start()
        child.join()

    before = policy()
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [os.SCHED_IDLE, os.SCHED_IDLE]
    assert policy() == before != os.SCHED_IDLE
