# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The executor of all nodes: what comes often is done at once, what may take long is done beside."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Task

# One for a reconstruction, the others for what is asked for meanwhile.
_THREADS = 3


class NodeExecutor(SingleThreadedExecutor):
    """Runs callbacks in the thread that spins, but services of reentrant groups, which may take long, in threads.

    A MultiThreadedExecutor hands every callback to a thread, and waits for all entities anew when it has begun and when
    it has ended. In Python that takes longer than most callbacks, and messages come a hundred times a second. Topics of
    reentrant groups, as TF has them, would even keep it busy until a thread has taken the message.
    """

    def __init__(self) -> None:
        super().__init__()
        self._threads = ThreadPoolExecutor(_THREADS, "services")
        # Handed to the threads; of these, those that none has begun with.
        self._beside: set[Task] = set()
        self._queued: set[Task] = set()

    def wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> tuple[Task, Any, Node]:
        """See Executor; in place of a service that may take long, what hands it to a thread.

        Raises what a service in a thread has raised.
        """
        for task in [task for task in self._beside if task.done()]:
            self._beside.remove(task)
            task.result()
        ready: tuple[Task, Any, Node] = super().wait_for_ready_callbacks(*args, **kwargs)
        task, entity, node = ready
        if isinstance(entity, Service) and isinstance(entity.callback_group, ReentrantCallbackGroup):
            return Task(self._hand_on, (task,), executor=self), entity, node
        return ready

    def _hand_on(self, task: Task) -> None:
        """Of one that waits for something, or for a thread, this is asked again and again."""
        self._beside.add(task)
        if task not in self._queued:
            self._queued.add(task)
            self._threads.submit(self._run, task)

    def _run(self, task: Task) -> None:
        self._queued.discard(task)
        task()
