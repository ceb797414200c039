# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""reconstruct_node: clouds in the map frame to a wire mesh and a mesh, on request or as the clouds come."""

from __future__ import annotations

import math
import os
import sys
import traceback
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.geometry.cloud import ALL_PIECES, Piece, concatenate
from g2_recon.nodes import conversions
from g2_recon.nodes.journals import MessageJournal, Part
from g2_recon.nodes.markers import MarkerTopic, drawings_of_mesh, drawings_of_wire_mesh, vertex_errors
from g2_recon.nodes.memory import give_back_memory
from g2_recon.nodes.parameters import ReconstructParameters
from g2_recon.nodes.ros import reliable_qos, run, yield_processor
from g2_recon.nodes.stage_node import StageNode, session_folder
from g2_recon.reconstruction import collected_cloud
from g2_recon.reconstruction.collected_cloud import CollectedCloud
from g2_recon.reconstruction.face_errors import face_errors
from g2_recon.reconstruction.growing import GrowingReconstruction
from g2_recon.reconstruction.reconstructor import reconstruct
from g2_recon.reconstruction.result import Reconstruction
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.meshes import write_mesh, write_wire_mesh

# So often the thread beside looks for what is to be done; in between, others have the processor.
_LOOK_S = 0.2
# A reconstruction that was asked for waits so long for the live one.
_PATIENCE_S = 60.0


class ReconstructNode(StageNode[ReconstructParameters]):
    """Collects clouds; ~/reconstruct works on what there is in a thread of its own, so that none is lost meanwhile.

    With `rebuild` another thread keeps the mesh up with the clouds.
    """

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__("reconstruct_node", ReconstructParameters)
        self._collected = CollectedCloud(self.settings.spacing, self.settings.enough_points)
        self._newest_stamp = Time()
        self._growing: GrowingReconstruction | None = None
        self._result: Reconstruction | None = None
        self._config = _config_of(self.settings)
        self._drawn_by = self.settings.color_by
        self._collecting = Lock()
        self._reconstructing = Lock()
        self._building = Lock()
        self._showing = Lock()
        # How many changes of the clouds there were, how many of them are in the mesh, how often all was forgotten.
        self._changes = self._shown_changes = self._resets = self._accepted = 0
        self._stage = self._lack = ""
        self._rebuilt_at, self._took = -math.inf, 0.0
        self._wire_mesh_topic = MarkerTopic(self, "wire_mesh")
        self._mesh_topic = MarkerTopic(self, "mesh")
        beside = ReentrantCallbackGroup()
        self.offer_trigger("~/reconstruct", self._reconstruct, group=beside)
        self.offer_trigger("~/save", self._save, group=beside)
        self.offer_trigger("~/reset", self._reset)
        self.offer_pause()
        takers = {topic: (PointCloud2, partial(self._on_cloud, topic)) for topic in self.settings.cloud_topics}
        self._journal = MessageJournal(self, self.settings.session_dir, "clouds.journal", takers)
        self._journal.take_up()
        for topic in self.settings.cloud_topics:
            qos = reliable_qos(self.settings.queue_depth)
            self.listen(PointCloud2, topic, takers[topic][1], qos)
        if self.settings.mode == "solid":
            # Clouds are taken in meanwhile, and written to the journal.
            self.compile_beside("reconstruction", hold=False)
        self._ending = Event()
        self._beside = Thread(target=self._work_beside, name="reconstruct_node beside", daemon=True)
        self._beside.start()

    def end(self) -> None:
        """End the thread beside first: it works with what the node has."""
        self._ending.set()
        self._beside.join()
        super().end()

    def waiting_for(self) -> str:
        """See StageNode."""
        lacks = "; ".join(filter(None, map(self.not_received, self.settings.cloud_topics)))
        return lacks or (f"no mesh yet: {self._lack}" if self._lack else "")

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        values: dict[str, object] = {
            "accepted clouds": self._accepted,
            "points": len(self._collected),
            "points not kept where there are enough": self._collected.redundant,
            "reconstruction": self._stage or "idle",
        }
        if self._result is not None:
            values["faces"] = len(self._result.mesh.faces)
            values["submaps"] = self._result.clusters
            values["points of the mesh"] = self._result.points
        if self._took:
            values["last live update s"] = round(self._took, 2)
        return values

    def settings_changed(self) -> None:
        """See StageNode."""
        config, self._config = self._config, _config_of(self.settings)
        if self._config != config:
            # What was made with other settings is no beginning.
            self._growing = None
            self._changes += 1

    def _on_cloud(self, topic: str, message: PointCloud2) -> None:
        if message.header.frame_id != self.settings.map_frame:
            frames = f"it is in '{message.header.frame_id}', not '{self.settings.map_frame}'"
            self.drop("cloud in another frame", frames)
            return
        received = self.usable(conversions.cloud_and_piece_from_message, message, "cloud")
        if received is None:
            return
        cloud, piece = received
        usable = conversions.usable_points(cloud)
        if len(usable) < len(cloud) and not (piece is not None and piece.number == ALL_PIECES):
            self.drops["point that is not finite or absurdly far away"] += len(cloud) - len(usable)
        with self._collecting:
            # What is placed anew is replaced also meanwhile: nobody will send it again.
            refused = self._collected.add(usable, piece, topic=topic, leave_out=self.paused)
            if not refused:
                self._changes += 1
                self._accepted += 1
                self._newest_stamp = max(self._newest_stamp, message.header.stamp, key=conversions.stamp_seconds)
        if not refused:
            self._keep(topic, message, piece)
        else:
            self._journal.leave_out()
            self.drops["cloud while paused" if refused == "left out" else f"cloud {refused}"] += 1

    def _keep(self, topic: str, message: PointCloud2, piece: Piece | None) -> None:
        if piece is None:
            self._journal.keep(topic, message)
            return
        group = topic, piece.source
        if piece.number == ALL_PIECES:
            self._journal.forget(group)
        self._journal.keep(topic, message, Part(group, piece.number, piece.revision))

    def _reconstruct(self) -> str:
        while self.compiling and self.context.ok() and not self._ending.is_set():
            self._ending.wait(_LOOK_S)
        if not self._reconstructing.acquire(blocking=False):
            raise InputError("a reconstruction is being made", advice="wait until it is done")
        try:
            result = self._rebuild(anew=True)
        finally:
            self._reconstructing.release()
        return (
            f"{result.points} points, {result.clusters} clusters, {len(result.wire_mesh.vertices)} neurons, "
            f"{int(result.wire_mesh.join.sum())} joins, {len(result.mesh.faces)} faces"
        )

    def _work_beside(self) -> None:
        """Keep the mesh up with the clouds, and the markers with the mesh, until the node ends.

        On a small computer poses come first: nobody waits for a mesh as a robot does for where it is.
        """
        yield_processor()
        while not self._ending.wait(_LOOK_S) and self.context.ok():
            self._look()

    def _look(self) -> None:
        try:
            if self.compiling:
                return
            if self._is_due():
                self._rebuild(anew=False)
            elif self._result is not None and self._drawn_by != self.settings.color_by:
                self._draw_again()
            for topic in (self._wire_mesh_topic, self._mesh_topic):
                topic.settle(monotonic())
        except InputError as error:
            self._lack = str(error)
        except ExternalShutdownException:
            pass
        except Exception:
            # A fault in here must not end the mesh for good: with other points it may be made again.
            self._growing = None
            if self.context.ok():
                self.say_once("live mesh", f"live mesh: {traceback.format_exc()}")

    def _is_due(self) -> bool:
        if self.settings.rebuild == "on_request" or self._changes == self._shown_changes or not len(self._collected):
            return False
        period = self.settings.rebuild_period if self.settings.rebuild == "every_n_seconds" else 0.0
        return monotonic() - self._rebuilt_at >= period

    def _rebuild(self, *, anew: bool) -> Reconstruction:
        """Make the mesh of what there is, anew or from the one before, and show it."""
        if not self._building.acquire(timeout=_PATIENCE_S):
            raise InputError("the live mesh is being made", advice="wait until it is done")
        try:
            self._rebuilt_at = began = monotonic()
            with self._collecting:
                parts, stamp = self._collected.parts(), self._newest_stamp
                changes, resets, settings = self._changes, self._resets, self.settings
            # What cannot be made of these is not tried again.
            self._shown_changes = changes
            result = self._made(parts, settings, anew=anew)
            self._show(result, parts, conversions.header(stamp, settings.map_frame), resets)
            self._took = 0.0 if anew else monotonic() - began
            return result
        finally:
            self._stage = ""
            self._building.release()
            # Each update works with copies of all points, of which the memory would else grow by half.
            give_back_memory()

    def _draw_again(self) -> None:
        """Show the mesh there is in other colors."""
        with self._building:
            with self._collecting:
                parts, stamp, resets = self._collected.parts(), self._newest_stamp, self._resets
            if self._result is not None:
                self._show(self._result, parts, conversions.header(stamp, self.settings.map_frame), resets)

    def _show(
        self, result: Reconstruction, parts: Mapping[Hashable, collected_cloud.Part], head: Header, resets: int
    ) -> None:
        """Publish a result, unless what it was made of was forgotten meanwhile."""
        color_by = self.settings.color_by
        errors = of_vertices = None
        if color_by == "error" and len(result.mesh.faces):
            workers = self.settings.workers or os.cpu_count() or 1
            points = concatenate([part.cloud for part in parts.values()]).points
            errors = face_errors(result.mesh, points, limit=self.settings.spacing, workers=workers)
            of_vertices = vertex_errors(result.mesh, errors)
        by_height = color_by == "height"
        wire_mesh = drawings_of_wire_mesh(result.wire_mesh, of_vertices, by_height=by_height)
        mesh = drawings_of_mesh(result.mesh, errors, by_height=by_height)
        with self._showing:
            if resets == self._resets:
                self._result, self._lack, self._drawn_by = result, "", color_by
                self._wire_mesh_topic.show(head, wire_mesh, monotonic())
                self._mesh_topic.show(head, mesh, monotonic())

    def _made(
        self, parts: dict[Hashable, collected_cloud.Part], settings: ReconstructParameters, *, anew: bool
    ) -> Reconstruction:
        if settings.mode == "paper" or settings.rebuild == "on_request":
            self._growing = None
            cloud = concatenate([part.cloud for part in parts.values()])
            return reconstruct(cloud, settings, progress=self._on_progress)
        growing = self._growing
        if anew or growing is None:
            growing = GrowingReconstruction(settings)
        result = growing.update(parts, progress=self._on_progress)
        if _config_of(settings) == self._config:
            self._growing = growing
        return result

    def _on_progress(self, stage: str, done: int, total: int) -> None:
        self._stage = f"{stage} {done} of {total}"
        if done == total:
            # What a stage leaves would else be there beside what the next one takes.
            give_back_memory()
        if not self.context.ok():
            raise ExternalShutdownException

    def _save(self) -> str:
        folder = session_folder(self.settings.session_dir)
        with self._collecting:
            cloud = self._collected.cloud()
        if not len(cloud):
            raise InputError("there is nothing to save", advice=self.waiting_for() or "send clouds first")
        write_cloud(folder / "cloud.ply", cloud)
        written = f"cloud.ply ({len(cloud)} points)"
        if self._result is not None:
            write_wire_mesh(folder / "wire_mesh.ply", self._result.wire_mesh)
            write_mesh(folder / "mesh.ply", self._result.mesh)
            written += f", wire_mesh.ply and mesh.ply ({len(self._result.mesh.faces)} faces)"
        else:
            written += "; no mesh: call ~/reconstruct first"
        return f"wrote to {folder}: {written}"

    def _reset(self) -> str:
        """Forget clouds and meshes; what is shown is cleared too."""
        with self._collecting:
            self._collected.clear()
            self._resets += 1
        self._journal.clear()
        head = conversions.header(self._newest_stamp, self.settings.map_frame)
        with self._showing:
            self._result, self._lack = None, ""
            for topic in (self._wire_mesh_topic, self._mesh_topic):
                topic.clear(head)
        return "forgot all points and meshes"


def _config_of(settings: ReconstructParameters) -> dict[str, Any]:
    """What a reconstruction depends on."""
    return settings.model_dump(include=set(ReconstructionConfig.model_fields))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(ReconstructNode, args)


if __name__ == "__main__":
    sys.exit(main())
