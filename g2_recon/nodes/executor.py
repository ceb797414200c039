# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The executor of all nodes: what comes often is done at once, what may take long is done beside."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Task

# One for a reconstruction, the others for what is asked for meanwhile.
_THREADS = 3


class NodeExecutor(SingleThreadedExecutor):
    """Runs callbacks in the thread that spins, and those of reentrant groups, which may take long, in threads beside.

    A MultiThreadedExecutor hands every callback to a thread, and waits for all entities anew when it has begun and when
    it has ended. In Python that takes longer than most callbacks, and messages come a hundred times a second.
    """

    def __init__(self) -> None:
        super().__init__()
        self._threads = ThreadPoolExecutor(_THREADS, "callbacks")
        self._beside: set[Task] = set()

    def wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> tuple[Task, Any, Node]:
        """See Executor; in place of a callback that may take long, what hands it to a thread.

        Raises what a callback in a thread has raised.
        """
        for task in [task for task in self._beside if task.done()]:
            self._beside.remove(task)
            task.result()
        ready: tuple[Task, Any, Node] = super().wait_for_ready_callbacks(*args, **kwargs)
        task, entity, node = ready
        if isinstance(getattr(entity, "callback_group", None), ReentrantCallbackGroup):
            self._beside.add(task)
            task = Task(self._threads.submit, (task,), executor=self)
        return task, entity, node
