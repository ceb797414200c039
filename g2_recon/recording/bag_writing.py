# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""A recording to a bag, of ROS 2 or ROS 1."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from g2_recon.errors import InputError
from g2_recon.geometry.recording import Recording
from g2_recon.recording.bag_messages import TF_STATIC, TRANSFORMS, Series, all_series
from g2_recon.recording.files import atomic_write

_NO_DESCRIPTION: Mapping[str, str] = MappingProxyType({})


def write_bag(
    path: str | Path,
    recording: Recording,
    *,
    description: Mapping[str, str] = _NO_DESCRIPTION,
    overwrite: bool = False,
) -> None:
    """Write a rosbag2 directory: metadata.yaml and one MCAP file with zstd chunks, as ROS 2 Jazzy plays it.

    Topics are those of RecordingConfig's defaults; mounting poses go to /tf_static, from base_link to the frames of
    the scans. `description` is kept as the custom data of the metadata. Ranges are kept exactly, stamps to the
    nanosecond, angles as float32. Odometry is `scan_odometry` at the stamps of the scans, or `odometry` without it;
    `drops` have no place in a bag. Negative stamps shift all stamps by whole seconds, with a warning in the log.

    Raises InputError if `path` exists (with `overwrite`: is something else than a bag), the recording is empty, a
    stamp cannot be a ROS time, lasers with different mounting poses have the same frame, or it cannot be written.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    series = all_series(recording, store, where=path)
    with _fresh_directory(Path(path), overwrite=overwrite) as place:
        writer = rosbag2.Writer(place, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        # Chunks packed inside the MCAP file, which keeps its index; packed files or messages would need a plugin.
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        for key, value in description.items():
            writer.set_custom_data(key, value)
        with writer:
            connections = {
                item.topic: writer.add_connection(
                    item.topic,
                    item.msgtype,
                    typestore=store,
                    offered_qos_profiles=[_offered_qos(is_latched=item.topic == TF_STATIC)],
                )
                for item in series
            }
            for received, item, message in _in_time_order(series):
                writer.write(connections[item.topic], received, store.serialize_cdr(message, item.msgtype))


def write_ros1_bag(path: str | Path, recording: Recording, *, overwrite: bool = False) -> None:
    """Write a ROS 1 bag (version 2.0, LZ4), with the topics and the limits of write_bag.

    Raises InputError as write_bag does.
    """
    store = get_typestore(Stores.ROS1_NOETIC)
    # rosbags has no tf2_msgs among the types of Noetic.
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    series = all_series(recording, store, where=path)
    with atomic_write(path) as temporary:
        if Path(path).exists() and not overwrite:
            raise _exists(path)
        writer = rosbag1.Writer(temporary)
        writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        with writer:
            connections = {
                item.topic: writer.add_connection(
                    item.topic, item.msgtype, typestore=store, latching=int(item.topic == TF_STATIC)
                )
                for item in series
            }
            for received, item, message in _in_time_order(series):
                writer.write(connections[item.topic], received, store.serialize_ros1(message, item.msgtype))


@contextmanager
def _fresh_directory(target: Path, *, overwrite: bool) -> Iterator[Path]:
    """A path of the same name as the target, which takes its place when all went well.

    The name has to be the same because rosbags names the file in the directory after it.
    """
    try:
        if target.exists() and not overwrite:
            raise _exists(target)
        if target.exists() and not (target / "metadata.yaml").is_file():
            raise InputError("exists and is no bag", where=target, advice="choose another name or remove it")
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as scratch:
            made = Path(scratch) / target.name
            yield made
            if target.exists():
                target.rename(Path(scratch) / "replaced")
            made.rename(target)
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}", where=target, advice="choose another place or make room"
        ) from error


def _exists(path: str | Path) -> InputError:
    return InputError("exists already", where=path, advice="choose another name or ask to overwrite it")


def _in_time_order(series: list[Series]) -> Iterator[tuple[int, Series, Any]]:
    """Time of receipt, series and message, over all topics in order of time."""
    streams = [
        [
            (received, rank, item, message)
            for received, message in zip(item.received.tolist(), item.messages, strict=True)
        ]
        for rank, item in enumerate(series)
    ]
    for received, _, item, message in heapq.merge(*streams, key=lambda entry: entry[:2]):
        yield received, item, message


def _offered_qos(*, is_latched: bool) -> Qos:
    """Reliable, so that subscribers of either kind are served; a latched topic keeps its last message."""
    not_said = QosTime(0, 0)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if is_latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if is_latched else QosDurability.VOLATILE,
        deadline=not_said,
        lifespan=not_said,
        liveliness=QosLiveliness.SYSTEM_DEFAULT,
        liveliness_lease_duration=not_said,
        avoid_ros_namespace_conventions=False,
    )
