# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""map_merger_node: keyframes and clouds of several robots to one map and one cloud in the world."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from secrets import randbits
from time import monotonic
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import OccupancyGrid as GridMessage
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt8MultiArray, UInt32, UInt32MultiArray

from g2_recon.collaboration.growing_session import GrowingSession
from g2_recon.collaboration.live_merger import LiveMerger, Place, StoredSweepWork, Work
from g2_recon.config import LocalizationConfig
from g2_recon.errors import InputError
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.nodes import conversions
from g2_recon.nodes.journals import MessageJournal
from g2_recon.nodes.keyframes import part_of_message
from g2_recon.nodes.merging_process import Made, MergingProcess, Placed
from g2_recon.nodes.parameters import MapMergerParameters
from g2_recon.nodes.ros import LATCHED, RobotTransforms, reliable_qos, run
from g2_recon.nodes.stage_node import StageNode

# How often robots are looked for, and whoever subscribes late, maps merged and transforms sent, s.
_WATCH_PERIOD_S, _MERGE_PERIOD_S, _TF_PERIOD_S = 0.5, 0.2, 0.1
# Pieces are gathered for so long, and then handed on for so long at a time, s.
_GATHER_S, _SEND_S, _SEND_PERIOD_S = 0.25, 0.004, 0.015
# Transforms hold until the next one comes, s.
_TF_AHEAD_S = 0.2
# What is lacking is asked for so often, s, and so many times.
_ASK_AGAIN_S, _MOST_ASKED = 2.0, 5
_LEVELS = {
    "aligned": DiagnosticStatus.OK,
    "waiting": DiagnosticStatus.WARN,
    "ambiguous": DiagnosticStatus.WARN,
    "stale": DiagnosticStatus.STALE,
    "rejected": DiagnosticStatus.WARN,
}


class _Gap:
    """Messages of a source from one sequence number to before another that have not come."""

    def __init__(self, begin: int, end: int) -> None:
        self.begin, self.end = begin, end
        self.asked_at = -math.inf
        self.asked = 0


class _Takers(dict[str, tuple[type, Callable[..., None]]]):
    """What takes up the messages of a journal, which are named by topic and robot."""

    def get(self, name: str, default: Any = None) -> Any:
        topic, _, robot = name.partition(" ")
        if topic not in self:
            return default
        kind, take = self[topic]
        return kind, partial(take, robot)


class MapMergerNode(StageNode[MapMergerParameters]):
    """Collects what robots tell, merges it in a process beside, and hands on the map and the clouds in the world."""

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__("map_merger_node", MapMergerParameters)
        self._transforms = RobotTransforms(self)
        grid = {name: getattr(self.settings, name) for name in ("map_spacing", "grid_resolution")}
        self._merging = MergingProcess(LocalizationConfig(**grid))
        self._newest_stamp, self._subscribers = Time(), 0
        # Sources whose points were taken back, or that were handed on by a node that is no more.
        self._gone: dict[int, None] = {}
        self._wanted: dict[str, dict[str, Any]] = {}
        self._frames: dict[str, str] = {}
        self._journal = MessageJournal(
            self,
            self.settings.session_dir,
            "merger.journal",
            _Takers(
                keyframes=(UInt8MultiArray, self._on_keyframes),
                cloud=(PointCloud2, self._on_cloud),
                source=(UInt32, lambda robot, message: self._gone.setdefault(message.data)),
            ),
        )
        self._begin()
        self._connect()
        self._journal.take_up()

    def _begin(self) -> None:
        self._merger = LiveMerger(
            {robot: np.array(start) for robot, start in self.settings.known_starts.items()}, self._new_source
        )
        self._next_sequence: dict[tuple[str, int], int] = {}
        self._gaps: dict[tuple[str, int], list[_Gap]] = {}
        self._asked_keyframes: dict[str, tuple[int, float]] = {}
        self._work: tuple[Work | StoredSweepWork, Future[Made | Placed]] | None = None
        self._rest_until = self._grew_at = -math.inf
        self._merging_takes = 0.0

    def _new_source(self) -> int:
        source = randbits(32)
        self._journal.keep("source", UInt32(data=source))
        return source

    def _connect(self) -> None:
        self._alignments_publisher = self.create_publisher(DiagnosticArray, "alignments", LATCHED)
        self._cloud_publisher = self.create_publisher(PointCloud2, "cloud", reliable_qos(self.settings.queue_depth))
        self._map_publisher = self.create_publisher(GridMessage, "map", LATCHED)
        self._points_publisher = self.create_publisher(PointCloud2, "point_map", LATCHED)
        self.offer_trigger("~/reset", self._reset)
        for robot in self.settings.names:
            self._listen_to(robot)
        for period, action in (
            (_WATCH_PERIOD_S, self._watch),
            (_MERGE_PERIOD_S, self._merge),
            (1.0, self._publish_alignments),
        ):
            self.create_timer(period, action, clock=self.steady_clock)
        self._sending_timer = self.create_timer(_GATHER_S, self._send, clock=self.steady_clock)
        if self.settings.publish_tf and self._transforms.available:
            self.create_timer(_TF_PERIOD_S, self._send_transforms, clock=self.steady_clock)

    def _listen_to(self, robot: str) -> None:
        self._wanted[robot] = {
            topic: self.create_publisher(UInt32MultiArray, f"{robot}/{topic}", reliable_qos(self.settings.queue_depth))
            for topic in ("keyframes_wanted", "cloud_wanted")
        }
        depth = self.settings.queue_depth
        self.listen(UInt8MultiArray, f"{robot}/keyframes", partial(self._on_keyframes, robot), LATCHED)
        self.listen(PointCloud2, f"{robot}/cloud", partial(self._on_cloud, robot), reliable_qos(depth))

    def waiting_for(self) -> str:
        """See StageNode."""
        lack = "no robot yet: nobody publishes `<robot>/keyframes` or `<robot>/cloud`, or name them in `robots`"
        return "" if self._robots() else lack

    def doubts(self) -> Iterator[str]:
        """See StageNode."""
        for robot in self._robots():
            state, place = self._state(robot)
            if state != "aligned":
                yield f"{robot} is {state}: {self._reason(robot, state, place)}"

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        cloud = self._merger.cloud
        return {
            "robots": len(self._robots()),
            **{f"state of {robot}": self._state(robot)[0] for robot in self._robots()},
            "points": cloud.points,
            "points without a place in the world": cloud.unplaced,
            "pieces to be sent": cloud.waiting,
            "messages that are lacking": sum(gap.end - gap.begin for gaps in self._gaps.values() for gap in gaps),
            "last merging took": f"{self._merging_takes:.1f} s",
        }

    def _robots(self) -> list[str]:
        return sorted({*self.settings.names, *self._wanted, *self._merger.robots})

    def _on_keyframes(self, robot: str, message: UInt8MultiArray) -> None:
        told = self.usable(part_of_message, message, "keyframes")
        if told is None:
            return
        part, self._frames[robot] = told
        known = self._merger.session(robot, part.number)
        before = None if known is None else known.version
        try:
            growing = self._merger.take_part(robot, part)
        except InputError as error:
            self.drop("unusable keyframes", str(error))
            return
        if growing.version != before:
            self._grew_at = monotonic()
            self._journal.keep(f"keyframes {robot}", message)
        self._note_stamp(part.last_stamp)
        self._ask_for_keyframes(robot, growing, part.first)

    def _ask_for_keyframes(self, robot: str, growing: GrowingSession, first: int) -> None:
        """Ask for those that are lacking: when the last ones that were asked for have come, or after some time."""
        asked, at = self._asked_keyframes.get(robot, (-1, -math.inf))
        if growing.lacks and robot in self._wanted and (first == asked or monotonic() - at > _ASK_AGAIN_S):
            self._asked_keyframes[robot] = len(growing), monotonic()
            request = UInt32MultiArray(data=[growing.number, len(growing)])
            self._wanted[robot]["keyframes_wanted"].publish(request)

    def _on_cloud(self, robot: str, message: PointCloud2) -> None:
        frame = self._frames.get(robot, message.header.frame_id)
        if message.header.frame_id != frame:
            self.drop("cloud in another frame", f"it is in '{message.header.frame_id}', not '{frame}'")
            return
        received = self.usable(conversions.cloud_and_piece_from_message, message, "cloud")
        if received is None:
            return
        cloud, piece = received
        if piece is None:
            self.drop("cloud that says nothing of its piece", "it cannot follow the map of its robot")
            return
        # A robot without keyframes tells its frame by its cloud only.
        self._frames.setdefault(robot, message.header.frame_id)
        stamp = conversions.stamp_seconds(message.header.stamp)
        refused = self._merger.take_cloud(robot, stamp, conversions.usable_points(cloud), piece)
        self._follow_sequence((robot, piece.source), conversions.sequence_from_message(message), piece.revision)
        if refused:
            self.drops[f"cloud {refused}"] += 1
        else:
            self._journal.keep(f"cloud {robot}", message)
        self._note_stamp(stamp)

    def _follow_sequence(self, source: tuple[str, int], sequence: int | None, revision: int) -> None:
        """Take note of messages that are lacking, and that they have come anew."""
        if sequence is None:
            return
        expected = self._next_sequence.get(source, 0)
        self._next_sequence[source] = max(expected, sequence + 1)
        if sequence > expected:
            self._gaps.setdefault(source, []).append(_Gap(expected, sequence))
        elif revision and self._gaps.get(source):
            # What was asked for comes as new revisions.
            self._gaps[source] = [gap for gap in self._gaps[source] if not gap.asked]

    def _ask_for_clouds(self) -> None:
        for (robot, source), gaps in self._gaps.items():
            for gap in gaps:
                if monotonic() - gap.asked_at > _ASK_AGAIN_S and gap.asked < _MOST_ASKED and robot in self._wanted:
                    gap.asked, gap.asked_at = gap.asked + 1, monotonic()
                    self._wanted[robot]["cloud_wanted"].publish(UInt32MultiArray(data=[source, gap.begin, gap.end]))

    def _note_stamp(self, seconds: float) -> None:
        if seconds > conversions.stamp_seconds(self._newest_stamp) and math.isfinite(seconds):
            self._newest_stamp = conversions.stamp_message(seconds)

    def _watch(self) -> None:
        """Find robots, ask for what is lacking, and give whoever comes late all that was before."""
        if not self.settings.names:
            for robot in self._discovered():
                self._listen_to(robot)
        self._ask_for_clouds()
        before, self._subscribers = self._subscribers, self._cloud_publisher.get_subscription_count()
        if self._subscribers > before:
            self._take_back(self._gone)
            self._merger.cloud.send_all()

    def _discovered(self) -> list[str]:
        """Namespaces of robots that are new, right below that of this node."""
        own = self.get_namespace().rstrip("/")
        kind_of = {"keyframes": "std_msgs/msg/UInt8MultiArray", "cloud": "sensor_msgs/msg/PointCloud2"}
        found = {
            match[1]
            for topic, kinds in self.get_topic_names_and_types()
            if (match := re.fullmatch(rf"{own}/([^/]+)/(keyframes|cloud)", topic)) and kind_of[match[2]] in kinds
        }
        return sorted(found - self._wanted.keys())

    def _merge(self) -> None:
        """Take what has been merged, and begin with what is new."""
        if self._work is not None:
            work, made = self._work
            if made.done():
                self._work = None
                self._take_merged(work, made)
            return
        now = monotonic()
        if now < self._rest_until:
            return
        settled = now - self._grew_at > self.settings.settle
        new = self._merger.work(settled=settled) or self._merger.sweep_work()
        if new is not None:
            self._work = new, self._merging.submit(new)

    def _take_merged(self, work: Work | StoredSweepWork, future: Future[Made | Placed]) -> None:
        try:
            made = future.result()
        except InputError as error:
            self.fail("merging", f"maps cannot be merged: {error}")
            self._rest_until = monotonic() + self.settings.settle
            return
        self.faults.pop("merging", None)
        # As long as it has taken, others have their turn.
        self._merging_takes = made.seconds
        self._rest_until = monotonic() + made.seconds
        if isinstance(work, Work) and isinstance(made, Made):
            self._merger.take_merged(work, made.map)
            self._show(made)
        elif isinstance(made, Placed):
            self._merger.take_placed(made.places)
        self._publish_alignments()

    def _show(self, made: Made) -> None:
        head = conversions.header(self._newest_stamp, self.settings.world_frame)
        if made.grid is not None:
            self._map_publisher.publish(conversions.grid_message(head, made.grid))
        flat = Cloud(np.column_stack([made.points, np.zeros(len(made.points))]))
        self._points_publisher.publish(conversions.cloud_to_message(head, flat))

    def _send(self) -> None:
        """Hand on pieces in the world, as many as there is time for."""
        cloud = self._merger.cloud
        gone = cloud.take_gone()
        self._take_back(gone)
        self._gone |= dict.fromkeys(gone)
        end = monotonic() + _SEND_S
        for stamp, points, piece in cloud.sent():
            head = conversions.header(conversions.stamp_message(stamp), self.settings.world_frame)
            # A message without points could not say of which piece it has none.
            shown = points if len(points) else Cloud(np.full((1, 3), np.nan))
            self._cloud_publisher.publish(conversions.cloud_to_message(head, shown, piece))
            if monotonic() > end:
                rest = _SEND_PERIOD_S
                break
        else:
            rest = _GATHER_S
        self._sending_timer.timer_period_ns = int(1e9 * rest)
        self._sending_timer.reset()

    def _take_back(self, sources: Any) -> None:
        head = conversions.header(self._newest_stamp, self.settings.world_frame)
        for source in sources:
            self._cloud_publisher.publish(conversions.no_pieces_message(head, source))

    def _state(self, robot: str) -> tuple[str, Place]:
        """State of a robot, and its place."""
        place = self._merger.place(robot)
        silent = self._silent_for(robot, place) > self.settings.stale_after
        return ("stale" if silent and place.session is not None else place.state), place

    def _silent_for(self, robot: str, place: Place) -> float:
        """For how long a robot has told nothing, s.

        One that makes sweeps tells clouds only, and none from one stop to the next: while it offers them it is there.
        """
        topic = f"{robot}/{'cloud' if place.sweeps else 'keyframes'}"
        source = self.inputs.get(topic)
        if source is None:
            return math.inf
        return 0.0 if place.sweeps and self.count_publishers(topic) else source.silent_for

    def _reason(self, robot: str, state: str, place: Place) -> str:
        if place.session is None:
            return self.not_received(f"{robot}/keyframes") if f"{robot}/keyframes" in self.inputs else place.reason
        if state != "stale":
            return place.reason
        silent = self._silent_for(robot, place)
        since = f"nothing came for {silent:.0f} s" if math.isfinite(silent) else "nothing came since the start"
        return f"{since}; what it told before is kept; {place.state}: {place.reason}"

    def _publish_alignments(self) -> None:
        message = DiagnosticArray(header=conversions.header(self._newest_stamp, self.settings.world_frame))
        for robot in self._robots():
            state, place = self._state(robot)
            values = {
                "state": state,
                "place": place.state,
                "keyframes": place.keyframes,
                "sessions": self._merger.sessions_of(robot),
            }
            if place.sweeps:
                values["sweeps"] = place.sweeps
            if place.session is not None:
                values["session"] = f"{place.session:08x}"
            if place.T_world_map is not None and place.covariance is not None:
                values |= dict(zip(("x", "y", "yaw"), (f"{value:.6f}" for value in place.T_world_map), strict=True))
                values["frame"] = self._frames.get(robot, "")
                if not place.sweeps:
                    values["way in common"] = f"{place.way:.1f} m"
                values["agreement"] = f"{place.agreement:.3f}"
                values["covariance"] = " ".join(f"{value:.3e}" for value in place.covariance.ravel())
            message.status.append(
                DiagnosticStatus(
                    name=robot,
                    level=_LEVELS[state],
                    message=f"{state}: {self._reason(robot, state, place)}",
                    values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
                )
            )
        self._alignments_publisher.publish(message)

    def _send_transforms(self) -> None:
        now = self.get_clock().now().nanoseconds * 1e-9
        if not now:
            return
        stamp = conversions.stamp_message(now + _TF_AHEAD_S)
        for robot in self._merger.robots:
            place = self._merger.place(robot)
            if place.T_world_map is not None:
                T = se3.from_se2(place.T_world_map) @ place.lift
                self._transforms.send(stamp, self.settings.world_frame, robot, self._frames.get(robot, ""), T)

    def _reset(self) -> str:
        """Forget all robots; what was handed on is taken back. What they still have comes once more."""
        self._merger.forget()
        self._send()
        self._journal.clear()
        self._gone = {}
        self._begin()
        return "forgot the maps and clouds of all robots"

    def end(self) -> None:
        """See StageNode."""
        self._merging.close()
        super().end()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(MapMergerNode, args)


if __name__ == "__main__":
    sys.exit(main())
