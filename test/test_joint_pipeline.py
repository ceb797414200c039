# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from g2_recon import joint_pipeline
from g2_recon.cli import main
from g2_recon.config import G2ReconConfig, LocalizationConfig, SimulationConfig, SweepConfig
from g2_recon.errors import InputError
from g2_recon.recording.bag_writing import write_bag
from g2_recon.recording.clouds import read_cloud
from g2_recon.recording.meshes import read_mesh
from g2_recon.simulation.simulator import simulate


@pytest.fixture(scope="module")
def recordings():
    """Two robots that drive through the same rooms: the first and the last part of one drive."""
    recording = simulate(SimulationConfig(seed=4, horizontal_every=8, vertical_every=60)).recording
    begin, end = recording.scans[0].stamp, recording.scans[-1].stamp
    middle = 0.5 * (begin + end)
    return {"a": between(recording, begin, middle + 25), "b": between(recording, middle - 25, end)}


def between(recording, begin, end):
    return dataclasses.replace(
        recording,
        scans=[scan for scan in recording.scans if begin <= scan.stamp <= end],
        scans_vertical=[scan for scan in recording.scans_vertical if begin <= scan.stamp <= end],
    )


@pytest.fixture(scope="module")
def folder(recordings, tmp_path_factory):
    """What the command makes of the bags of two robots."""
    place = tmp_path_factory.mktemp("robots")
    for name, recording in recordings.items():
        write_bag(place / name, recording)
    out = place / "out"
    assert main(["run", str(place / "a"), str(place / "b"), "-o", str(out)]) == 0
    return out


def test_several_bags_become_one_map_and_one_mesh(folder):
    summary = json.loads((folder / "summary.json").read_text())
    assert {name: robot["state"] for name, robot in summary["robots"].items()} == {"a": "aligned", "b": "aligned"}
    clouds = [read_cloud(folder / name / "cloud.ply") for name in "ab"]
    whole = read_cloud(folder / "cloud.ply")
    assert len(whole) == sum(map(len, clouds))
    assert len(read_mesh(folder / "mesh.ply")[1]) == summary["faces"]
    names = {"floor_plan.png", "mesh.png", "map.yaml", "map.pgm", "session.npz", "config.yaml", "mesh.glb"}
    assert names <= {path.name for path in folder.iterdir()}
    assert (folder / "a" / "trajectory.tum").exists()


def test_what_both_robots_saw_lies_on_the_same_walls(folder):
    one, other = (read_cloud(folder / name / "cloud.ply").points for name in "ab")
    distance, _ = cKDTree(one).query(other)
    shared = distance < 0.3
    # m; the vertical scans of both are 40 cm and more apart along the way, points of a scan 5 cm and more.
    assert shared.mean() > 0.1
    assert np.median(distance[shared]) < 0.15


def test_robots_with_the_same_name_are_refused(recordings, tmp_path, capsys):
    for place in ("x", "y"):
        write_bag(tmp_path / place / "a", recordings["a"])
    assert main(["run", str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a")]) == 1
    assert "two recordings have this name" in capsys.readouterr().err


@pytest.mark.parametrize("localization", [LocalizationConfig(method="paper"), LocalizationConfig(map="map.npz")])
def test_settings_that_make_no_map_to_merge_are_refused(recordings, localization):
    with pytest.raises(InputError, match="mapped one by one and then merged"):
        joint_pipeline.run(recordings, G2ReconConfig(localization=localization))


@pytest.fixture(scope="module")
def sweeping():
    """A robot that stands and tilts its laser in the same building."""
    return simulate(SimulationConfig(seed=5, setup="sweeping", horizontal_every=9)).recording


def test_a_recording_of_a_tilting_laser_is_that_of_a_robot_that_makes_sweeps(recordings, sweeping, tmp_path):
    settings = G2ReconConfig()
    result = joint_pipeline.run({"s": sweeping, "a": recordings["a"]}, settings)
    run = result.swept["s"]
    assert run.sweeps == 6
    assert run.place.reason
    assert len(result.cloud) == len(result.robots["a"].registration.cloud) + run.in_map * len(run.cloud)
    summary = joint_pipeline.summarize(result)
    assert summary["robots"]["s"]["state"] == run.place.state
    joint_pipeline.write_run(result, settings, tmp_path, summary=summary)
    assert len(read_cloud(tmp_path / "s" / "cloud.ply")) == len(run.cloud)
    assert (tmp_path / "s" / "trajectory.tum").exists()


def test_sweeps_alone_are_a_map_too(sweeping, tmp_path):
    settings = G2ReconConfig()
    result = joint_pipeline.run({"s": sweeping}, settings)
    assert result.map is None
    assert result.swept["s"].in_map
    joint_pipeline.write_run(result, settings, tmp_path, summary=joint_pipeline.summarize(result))
    assert (tmp_path / "mesh.ply").exists()


def test_sweeps_are_made_with_the_settings_of_the_run(sweeping):
    settings = G2ReconConfig(sweeps=SweepConfig(min_range=1.0, max_range=4.0))
    cloud = joint_pipeline.run({"s": sweeping}, settings).swept["s"].cloud
    ranges = np.linalg.norm(cloud.points - cloud.sensor, axis=1)
    assert ranges.min() > 1.0 - 1e-6 and ranges.max() < 4.0 + 1e-6  # m
