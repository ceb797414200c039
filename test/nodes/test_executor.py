# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""NodeExecutor: what it does at once, what beside, and what becomes of faults."""

import threading
from functools import partial

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from std_msgs.msg import UInt32
from std_srvs.srv import Trigger

from g2_recon.nodes.executor import NodeExecutor

PERIOD_S = 0.01


class Spinning:
    """A node whose callbacks run here until `done` is done."""

    def __init__(self):
        rclpy.init()
        self.node, self.executor, self.done = rclpy.create_node("node"), NodeExecutor(), Future()
        self.executor.add_node(self.node)

    def often(self, callback):
        self.node.create_timer(PERIOD_S, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def serve(self, name, answer):
        """A service that may take long; what calls it."""

        async def serve(_, response):
            told = answer()
            response.message = str(await told if isinstance(told, Future) else told)
            return response

        self.node.create_service(Trigger, name, serve, callback_group=ReentrantCallbackGroup())
        return partial(self.node.create_client(Trigger, name).call_async, Trigger.Request())

    def spin(self):
        self.executor.spin_until_future_complete(self.done, timeout_sec=20.0)
        assert self.done.done()

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def spinning():
    spinning = Spinning()
    yield spinning
    spinning.close()


def test_topics_run_in_the_thread_that_spins_and_services_of_reentrant_groups_do_not(spinning):
    threads = {}
    call = spinning.serve("service", lambda: threads.setdefault("service", threading.get_ident()))

    def take(_):
        threads["topic"] = threading.get_ident()
        call().add_done_callback(spinning.done.set_result)

    # As tf2_ros subscribes.
    spinning.node.create_subscription(UInt32, "topic", take, 10, callback_group=ReentrantCallbackGroup())
    publisher = spinning.node.create_publisher(UInt32, "topic", 10)
    publisher.publish(UInt32())
    spinning.spin()
    assert threads["topic"] == threading.get_ident() != threads["service"]


def test_a_service_that_takes_long_holds_nobody_up(spinning):
    released, ticks = threading.Event(), []
    call = spinning.serve("service", lambda: released.wait(10))
    call().add_done_callback(lambda answer: spinning.done.set_result(answer.result().message))

    def tick():
        ticks.append(None)
        if len(ticks) == 20:
            released.set()

    spinning.often(tick)
    spinning.spin()
    assert spinning.done.result() == "True"
    assert len(ticks) >= 20


def test_services_wait_where_all_threads_are_taken_and_each_is_done_once(spinning):
    released, ran = threading.Event(), []

    def work(number):
        ran.append(number)
        return released.wait(10)

    answers = [spinning.serve(f"service{number}", partial(work, number))() for number in range(6)]
    ticks = []

    def tick():
        ticks.append(None)
        if len(ticks) == 50:
            # Those that wait are handed on once, however often it is looked whether there is something to do.
            assert spinning.executor._threads._work_queue.qsize() == 3
            released.set()
        if all(answer.done() for answer in answers) and not spinning.done.done():
            spinning.done.set_result(None)

    spinning.often(tick)
    spinning.spin()
    assert sorted(ran) == list(range(6))


def test_a_coroutine_goes_on_when_what_it_waits_for_is_there(spinning):
    wanted = Future()
    call = spinning.serve("service", lambda: wanted)
    call().add_done_callback(lambda answer: spinning.done.set_result(answer.result().message))
    spinning.often(lambda: wanted.done() or wanted.set_result(42))
    spinning.spin()
    assert spinning.done.result() == "42"


def fail():
    raise ZeroDivisionError


def test_a_fault_of_a_callback_ends_the_spinning(spinning):
    spinning.often(fail)
    with pytest.raises(ZeroDivisionError):
        spinning.spin()


def test_a_fault_of_a_service_in_a_thread_ends_the_spinning(spinning):
    spinning.serve("service", fail)()
    spinning.often(lambda: None)
    with pytest.raises(ZeroDivisionError):
        spinning.spin()
