# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""reconstruct_node: clouds in the map frame to a wire mesh and a mesh, on request."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from threading import Lock

from builtin_interfaces.msg import Time
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from g2_recon.errors import InputError
from g2_recon.geometry.cloud import ALL_PIECES, Cloud, Piece
from g2_recon.nodes import conversions
from g2_recon.nodes.journals import MessageJournal
from g2_recon.nodes.parameters import ReconstructParameters
from g2_recon.nodes.ros import LATCHED, reliable_qos, run
from g2_recon.nodes.stage_node import StageNode, session_folder
from g2_recon.reconstruction.reconstructor import Reconstruction, Reconstructor, reconstruct
from g2_recon.recording.clouds import write_cloud
from g2_recon.recording.meshes import write_mesh, write_wire_mesh

# One for the reconstruction, the others for what goes on meanwhile.
_THREADS = 3


class ReconstructNode(StageNode[ReconstructParameters]):
    """Collects clouds; ~/reconstruct works on what there is in a thread of its own, so that none is lost meanwhile."""

    def __init__(self) -> None:
        """Raises ConfigError where a parameter is wrong."""
        super().__init__("reconstruct_node", ReconstructParameters)
        self._reconstructor = Reconstructor(self.settings)
        self._newest_stamp = Time()
        self._result: Reconstruction | None = None
        self._collecting = Lock()
        self._reconstructing = Lock()
        self._stage = ""
        self._wire_mesh_publisher = self.create_publisher(MarkerArray, "wire_mesh", LATCHED)
        self._mesh_publisher = self.create_publisher(MarkerArray, "mesh", LATCHED)
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

    def waiting_for(self) -> str:
        """See StageNode."""
        return "; ".join(filter(None, map(self.not_received, self.settings.cloud_topics)))

    def figures(self) -> dict[str, object]:
        """See StageNode."""
        return {"points": len(self._reconstructor), "reconstruction": self._stage or "idle"}

    def _on_cloud(self, topic: str, message: PointCloud2) -> None:
        if message.header.frame_id != self.settings.map_frame:
            frames = f"it is in '{message.header.frame_id}', not '{self.settings.map_frame}'"
            self.drop("cloud in another frame", frames)
            return
        received = self.usable(_cloud_and_piece, message, "cloud")
        if received is None:
            return
        cloud, piece = received
        usable = conversions.usable_points(cloud)
        if len(usable) < len(cloud) and not (piece is not None and piece.number == ALL_PIECES):
            self.drops["point that is not finite or absurdly far away"] += len(cloud) - len(usable)
        with self._collecting:
            # What is placed anew is replaced also meanwhile: nobody will send it again.
            refused = self._reconstructor.add_cloud(usable, piece, topic=topic, leave_out=self.paused)
            if not refused:
                self._newest_stamp = max(self._newest_stamp, message.header.stamp, key=conversions.stamp_seconds)
        if not refused:
            self._journal.keep(topic, message)
        else:
            self.drops["cloud while paused" if refused == "left out" else f"cloud {refused}"] += 1

    def _reconstruct(self) -> str:
        if not self._reconstructing.acquire(blocking=False):
            raise InputError("a reconstruction is being made", advice="wait until it is done")
        try:
            with self._collecting:
                cloud, stamp = self._reconstructor.cloud(), self._newest_stamp
            result = reconstruct(cloud, self.settings, progress=self._on_progress)
            self._result = result
            head = conversions.header(stamp, self.settings.map_frame)
            self._wire_mesh_publisher.publish(conversions.wire_mesh_markers(head, result.wire_mesh))
            self._mesh_publisher.publish(conversions.mesh_markers(head, result.mesh))
        finally:
            self._stage = ""
            self._reconstructing.release()
        return (
            f"{result.points} points, {result.clusters} clusters, {len(result.wire_mesh.vertices)} neurons, "
            f"{int(result.wire_mesh.join.sum())} joins, {len(result.mesh.faces)} faces"
        )

    def _on_progress(self, stage: str, done: int, total: int) -> None:
        self._stage = f"{stage} {done} of {total}"
        if not self.context.ok():
            raise ExternalShutdownException

    def _save(self) -> str:
        folder = session_folder(self.settings.session_dir)
        with self._collecting:
            cloud = self._reconstructor.cloud()
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
            self._reconstructor.reset()
        self._journal.clear()
        self._result = None
        head = conversions.header(self._newest_stamp, self.settings.map_frame)
        for publisher in (self._wire_mesh_publisher, self._mesh_publisher):
            publisher.publish(conversions.no_markers(head))
        return "forgot all points and meshes"


def _cloud_and_piece(message: PointCloud2) -> tuple[Cloud, Piece | None]:
    return conversions.cloud_from_message(message), conversions.piece_from_message(message)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; the exit code."""
    return run(ReconstructNode, args, threads=_THREADS)


if __name__ == "__main__":
    sys.exit(main())
