# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""What is asked of Fast DDS: memory of messages that are gone, and the wishes of the user."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from g2_recon.nodes import fast_dds

ROOT = Path(__file__).parents[2]

# What a process holds more after 100 messages of 200 kB were sent at once, and taken, MB.
HELD = """
import ctypes, os, sys, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray
from g2_recon.nodes.fast_dds import use_profile

class Mallinfo(ctypes.Structure):
    _fields_ = [(f"field{number}", ctypes.c_size_t) for number in range(10)]

libc = ctypes.CDLL(None)
libc.mallinfo2.restype = Mallinfo
used = lambda: (libc.mallinfo2().field7 + libc.mallinfo2().field4) / 1e6

profile = sys.argv[1] == "profile"
if profile:
    assert use_profile()
rclpy.init()
node = rclpy.create_node("test_fast_dds")
taken = []
qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
node.create_subscription(UInt8MultiArray, "large", lambda message: taken.append(len(message)), qos, raw=True)
publisher = node.create_publisher(UInt8MultiArray, "large", qos)
message = UInt8MultiArray(data=bytes(200_000))
end = time.monotonic() + 60
while publisher.get_subscription_count() == 0 and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
before = used()
for _ in range(100):
    publisher.publish(message)
while len(taken) < 100 and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
# The last ones are gone when the writer has heard that they came.
end = time.monotonic() + (10 if profile else 1)
while used() - before > 2 and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(len(taken), min(taken), used() - before, flush=True)
# Without the end of DDS, which is not what is tested.
os._exit(0)
"""


def held(what, folder):
    """How many messages came, of which size at least, and what is held in MB after they have gone."""
    environment = {name: value for name, value in os.environ.items() if name not in fast_dds._WISHES}
    environment |= {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    return subprocess.run(
        [sys.executable, "-c", HELD, what],
        check=True,
        capture_output=True,
        text=True,
        env=environment,
        cwd=folder,
        timeout=180,
    ).stdout.split()


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="asks glibc 2.33 or later what is held")
def test_memory_of_messages_that_are_gone_is_given_back(tmp_path):
    pytest.importorskip("rclpy", reason="sends messages")
    for what, least, most in (("profile", -1.0, 2.0), ("nothing", 10.0, 30.0)):
        count, size, megabytes = map(float, held(what, tmp_path))
        assert count == 100 and size > 200_000
        assert least < megabytes < most, what


def test_wishes_of_the_user_are_left_alone(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in fast_dds._WISHES:
        monkeypatch.delenv(name, raising=False)
    for name in fast_dds._WISHES:
        with monkeypatch.context() as inner:
            inner.setenv(name, "0")
            before = dict(os.environ)
            assert not fast_dds.use_profile() and dict(os.environ) == before
    for name in fast_dds._FILES_HERE:
        (tmp_path / name).touch()
        assert not fast_dds.use_profile()
        (tmp_path / name).unlink()
    assert not set(fast_dds._WISHES) & set(os.environ)


def test_the_profile_is_a_file_of_the_package(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    # Set first, so that they are as before after the test.
    for name in fast_dds._WISHES:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    assert fast_dds.use_profile()
    assert {os.environ[name] for name in fast_dds._FILES} == {str(fast_dds.PROFILE)}
    assert os.environ["RMW_FASTRTPS_USE_QOS_FROM_XML"] == "1"
    profiles = ElementTree.parse(fast_dds.PROFILE).getroot().findall("./{*}profiles/*[@is_default_profile='true']")
    participant, writer, reader = (
        [(each.tag.split("}")[1], each.text) for each in profile.iter() if each.text.strip()] for profile in profiles
    )
    assert participant == [("sec", "1"), ("count", "30")]
    # Of a writer and a reader also what ROS 2 asks for where it is not told to leave it to the file.
    assert writer == [("historyMemoryPolicy", "DYNAMIC"), ("kind", "SYNCHRONOUS"), ("kind", "OFF")]
    assert reader == [("historyMemoryPolicy", "DYNAMIC"), ("kind", "OFF")]
