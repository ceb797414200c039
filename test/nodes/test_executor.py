# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""NodeExecutor: what it does at once, what beside, and what becomes of faults."""

import threading
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.task import Future

from g2_recon.nodes.executor import NodeExecutor

PERIOD_S = 0.01


@pytest.fixture
def spinning():
    """`spinning(group=callback)` makes a node with timers, and spins it until a future is done."""
    rclpy.init()
    node, executor = rclpy.create_node("timers"), NodeExecutor()
    executor.add_node(node)

    def spin(until, **callbacks):
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        groups = {"often": None, "beside": ReentrantCallbackGroup()}
        for group, callback in callbacks.items():
            node.create_timer(PERIOD_S, callback, callback_group=groups[group], clock=clock)
        executor.spin_until_future_complete(until, timeout_sec=20.0)
        assert until.done()

    yield spin
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


def test_callbacks_run_in_the_thread_that_spins_and_those_of_reentrant_groups_do_not(spinning):
    done, seen = Future(), {}

    def note(name):
        seen[name] = threading.get_ident()
        if len(seen) == 2:
            done.set_result(None)

    spinning(done, often=lambda: note("often"), beside=lambda: note("beside"))
    assert seen["often"] == threading.get_ident() != seen["beside"]


def test_a_callback_that_takes_long_holds_nobody_up(spinning):
    done, released, ticks = Future(), threading.Event(), []

    def wait_long():
        if released.wait(10) and not done.done():
            done.set_result(None)

    def tick():
        ticks.append(time.monotonic())
        if len(ticks) == 20:
            released.set()

    spinning(done, often=tick, beside=wait_long)
    assert len(ticks) >= 20


def test_a_coroutine_goes_on_when_what_it_waits_for_is_there(spinning):
    done, wanted = Future(), Future()

    async def ask():
        answer = await wanted
        if not done.done():
            done.set_result(answer)

    spinning(done, beside=ask, often=lambda: wanted.done() or wanted.set_result(42))
    assert done.result() == 42


@pytest.mark.parametrize("group", ["often", "beside"])
def test_a_fault_of_a_callback_ends_the_spinning(spinning, group):
    def fail():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        spinning(Future(), **{group: fail})
