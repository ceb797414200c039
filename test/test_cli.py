# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The command as a user calls it: files in, files out, exit status and what is said."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import simulated_sweeps
import trimesh
import yaml
from simulated_sweeps import errors

from g2_recon import config
from g2_recon.cli import build_parser, bundled_recording, main
from g2_recon.config import G2ReconConfig, ReconstructionConfig
from g2_recon.geometry import se3
from g2_recon.geometry.cloud import Cloud
from g2_recon.geometry.mesh import Mesh, TrueSurface
from g2_recon.geometry.trajectory import Trajectory
from g2_recon.recording.clouds import read_cloud, write_cloud
from g2_recon.recording.meshes import write_mesh
from g2_recon.recording.occupancy_maps import read_map
from g2_recon.recording.recordings import read_recording
from g2_recon.recording.surfaces import read_true_surface, write_true_surface
from g2_recon.recording.trajectories import read_tum, write_tum

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
COMMANDS = [
    "demo",
    "run",
    "localize",
    "calibrate",
    "merge",
    "reconstruct",
    "import",
    "simulate",
    "evaluate relations",
    "evaluate surface",
]


def needs(path):
    return pytest.mark.skipif(not path.exists(), reason=f"the recording {path.name} is not here")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "-o", str(folder)]) == 0
    return folder


def refused(capsys, *arguments):
    """The one line that a refused command says."""
    assert main([str(argument) for argument in arguments]) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("g2-recon: ")]
    assert len(said) == 1
    return said[0]


def test_the_demo_writes_every_file_and_each_loads(demo):
    assert len(read_tum(demo / "trajectory.tum")) > 6000
    assert read_cloud(demo / "cloud.ply").sensor is not None
    assert config.load(demo / "config.yaml") == G2ReconConfig()
    meshes = [trimesh.load(demo / name, process=False, force="mesh") for name in ("mesh.ply", "mesh.glb")]
    assert len(meshes[0].faces) == len(meshes[1].faces) > 5000
    assert len(trimesh.load(demo / "wire_mesh.ply", process=False).vertices) > 5000
    assert {0, 100} < set(np.unique(read_map(demo / "map.yaml").cells).tolist())
    for name in ("floor_plan.png", "mesh.png"):
        assert (demo / name).read_bytes().startswith(b"\x89PNG")


def test_the_demo_stays_within_the_precision_of_the_paper(demo):
    summary = json.loads((demo / "summary.json").read_text())
    assert summary["trajectory_error_m"] <= 0.05
    assert summary["points"] == pytest.approx(126_000, rel=0.03)
    # Mixed pixels, which hang in the air between near and far.
    assert set(summary["dropped"]) <= {"isolated", "off the surface of their neighbors"}
    assert sum(summary["dropped"].values()) < 0.005 * summary["points"]
    assert summary["unmatched_scans"] == 0


def test_the_demo_is_the_run_on_the_bundled_recording(demo, tmp_path):
    assert main(["run", str(bundled_recording()), "-o", str(tmp_path), "--config", str(demo / "config.yaml")]) == 0
    assert (tmp_path / "mesh.ply").read_bytes() == (demo / "mesh.ply").read_bytes()
    assert (tmp_path / "trajectory.tum").read_bytes() == (demo / "trajectory.tum").read_bytes()


def test_neurons_of_the_demo_lie_near_the_true_surfaces(demo):
    truth = np.load(bundled_recording() / "truth" / "surfaces.npz")
    surface = trimesh.Trimesh(truth["truth_vertices"], truth["truth_faces"], process=False)
    samples, _ = trimesh.sample.sample_surface(surface, 400_000, seed=0)
    neurons = trimesh.load(demo / "wire_mesh.ply", process=False).vertices
    from scipy.spatial import cKDTree

    assert cKDTree(samples).query(neurons)[0].mean() < 0.10


def test_the_bundled_recording_says_that_it_is_simulated():
    metadata = yaml.safe_load((bundled_recording() / "metadata.yaml").read_text())
    assert "no robot has driven here" in metadata["rosbag2_bagfile_information"]["custom_data"]["simulated"]


def test_localize_writes_a_pose_a_scan_a_map_and_a_floor_plan(tmp_path):
    target = tmp_path / "way.tum"
    assert main(["localize", str(bundled_recording()), "-o", str(target)]) == 0
    assert len(read_tum(target)) == len(read_recording(bundled_recording()).scans)
    assert (tmp_path / "way.png").exists()
    assert read_map(tmp_path / "way.yaml").resolution == 0.05


def test_localize_goes_on_in_a_session_that_it_has_written(tmp_path, capsys):
    recording, session = str(bundled_recording()), tmp_path / "session.npz"
    assert main(["localize", recording, "-o", str(tmp_path / "a.tum"), "--session", str(session)]) == 0
    in_map = ["--map", str(session), "--mode", "localization"]
    assert main(["localize", recording, "-o", str(tmp_path / "b.tum"), *in_map]) == 0
    before, again = read_tum(tmp_path / "a.tum"), read_tum(tmp_path / "b.tum")
    off = np.hypot(*(before.positions - again.positions)[:, :2].T)
    # 2 cm; where it stands at the start it does not know its place.
    assert np.mean(off < 0.02) > 0.95
    assert main(["localize", recording, "-o", str(tmp_path / "c.tum"), *in_map, "--session", str(session)]) == 1
    assert "would replace what is read" in capsys.readouterr().err


def test_calibrate_finds_the_vertical_laser_and_its_settings_work(tmp_path, capsys):
    target = tmp_path / "robot.yaml"
    # 3 deg and 5 cm from how it is mounted.
    start = ["-0.02", "0.04", "0.6", "0.03", "-1.53", "0.02"]
    recording = str(bundled_recording())
    assert main(["calibrate", recording, "-o", str(target), "--registration.laser-pose", *start]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "sigma about y" in said
    assert "not observed, as at the start: z, the height" in said
    found = se3.from_xyz_rpy(config.load(target).registration.laser_pose)
    true = read_recording(bundled_recording()).T_base_laser_vertical
    # 1 cm, 0.3 deg; the height is that of the start.
    assert found[:3, 3] == pytest.approx(true[:3, 3], abs=0.01)
    assert errors(found, true)[1] < 0.3


def test_calibrate_says_what_is_missing(tmp_path, capsys):
    log = tmp_path / "empty.log"
    log.write_text("FLASER 2 1.0 1.0 0 0 0 0 0 0 1.0 host 1.0\n")
    assert "vertical laser" in refused(capsys, "calibrate", log)


@needs(DATA / "carmen" / "aces.clf.bz2")
def test_aces_is_localized_better_than_published_scan_matching(tmp_path, capsys):
    log, relations = DATA / "carmen" / "aces.clf.bz2", DATA / "relations" / "aces.relations"
    assert main(["localize", str(log), "-o", str(tmp_path / "aces.tum"), "--relations", str(relations)]) == 0
    shown = capsys.readouterr().err
    error = float(shown.split("translation error")[1].split()[1])
    # Scan matching in Kuemmerle et al. 2009.
    assert error < 0.173


@needs(DATA / "sweeps" / "pcl_room" / "room_scan1.pcd")
def test_a_room_is_reconstructed_from_a_sweep(tmp_path):
    cloud = DATA / "sweeps" / "pcl_room" / "room_scan1.pcd"
    assert main(["reconstruct", str(cloud), "-o", str(tmp_path / "room.obj")]) == 0
    mesh = trimesh.load(tmp_path / "room.obj", process=False, force="mesh")
    assert len(mesh.faces) > 5000
    assert (tmp_path / "room.png").exists()
    assert (tmp_path / "room_wire.ply").exists()


@needs(DATA / "carmen" / "laserazosSM3.log.gz")
def test_an_imported_log_is_the_log(tmp_path):
    log = DATA / "carmen" / "laserazosSM3.log.gz"
    assert main(["import", str(log), "-o", str(tmp_path / "bag")]) == 0
    written, original = read_recording(tmp_path / "bag"), read_recording(log)
    assert len(written.scans) == len(original.scans) == 778
    assert np.array_equal(written.scans[5].ranges, original.scans[5].ranges, equal_nan=True)


def test_simulate_writes_a_bag_with_its_truth_and_does_not_replace_it_unasked(tmp_path, capsys):
    bag = tmp_path / "bag"
    arguments = ["simulate", "-o", str(bag), "--vertical-every", "500", "--horizontal-every", "100"]
    assert main(arguments) == 0
    truth = read_true_surface(bag / "truth" / "surfaces.npz")
    assert len(truth.faces) > 500
    assert len(truth.seen) > 1000
    assert len(read_tum(bag / "truth" / "trajectory.tum")) > 1000
    assert "bag" in refused(capsys, *arguments)
    assert main([*arguments, "--force"]) == 0
    assert (bag / "truth" / "surfaces.npz").exists()


def test_the_bundled_recording_can_be_made_again(tmp_path):
    """The file is what the command of today makes."""
    assert main(["simulate", "-o", str(tmp_path / "bag")]) == 0
    again, bundled = read_recording(tmp_path / "bag"), read_recording(bundled_recording())
    assert len(again.scans) == len(bundled.scans)
    assert all(
        np.array_equal(one.ranges, other.ranges)
        for one, other in zip(again.scans_vertical, bundled.scans_vertical, strict=True)
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_each_option(command, capsys):
    with pytest.raises(SystemExit) as stop:
        build_parser().parse_args([*command.split(), "--help"])
    assert stop.value.code == 0
    assert "--verbose" in capsys.readouterr().out


def test_the_scores_are_explained_with_their_units(capsys):
    for score, said in (("relations", "translation in m and rotation in deg"), ("surface", "Distances in cm")):
        with pytest.raises(SystemExit):
            build_parser().parse_args(["evaluate", score, "--help"])
        assert said in " ".join(capsys.readouterr().out.split())


def test_every_setting_of_a_stage_is_an_option_of_its_command(capsys):
    for command, model, prefix in (
        ("reconstruct", ReconstructionConfig, ""),
        ("run", ReconstructionConfig, "reconstruction."),
    ):
        with pytest.raises(SystemExit):
            build_parser().parse_args([command, "--help"])
        shown = capsys.readouterr().out
        for setting in config.settings(model):
            assert f"--{prefix}{setting.name.replace('_', '-')}" in shown


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["localize"],
        ["reconstruct", "x.ply", "--theta", "much"],
        ["demo", "--speed", "9"],
        ["evaluate"],
        ["evaluate", "luck"],
        ["evaluate", "surface", "truth.npz"],
    ],
)
def test_bad_usage_ends_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2


@pytest.mark.parametrize("command", ["run", "localize", "merge", "reconstruct"])
def test_a_missing_file_is_one_line_and_status_1(command, tmp_path, capsys):
    assert "nowhere.ply" in refused(capsys, command, tmp_path / "nowhere.ply")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["reconstruct", "x.ply", "--min-sensor-distance", "99"], "--min-sensor-distance: 99 is not in 0 to 10"),
        (["reconstruct", "x.ply", "--theta", "nan"], "--theta: nan is not in"),
        (["localize", "x.log", "--max-range", "-1e-3"], "--max-range: -1e-3 is not in"),
        (["localize", "x.log", "--min-range", "9", "--max-range", "5"], "--min-range must be smaller than --max-range"),
        (
            ["run", "x", "--localization.min-range", "9", "--localization.max-range", "5"],
            "--localization.min-range must",
        ),
        (["run", "x", "--registration.laser-pose", "0", "0", "0", "0", "0", "inf"], "--registration.laser-pose"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_an_option_out_of_its_range_is_bad_usage_that_names_it_as_typed(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


def test_a_wrong_settings_file_is_one_line_and_status_1(tmp_path, capsys):
    file = tmp_path / "config.yaml"
    file.write_text("reconstruction:\n  theta: 99\n")
    assert "theta" in refused(capsys, "run", tmp_path / "bag", "--config", file)


def test_a_mounting_pose_may_be_given_with_negative_exponents():
    options = build_parser().parse_args(
        ["localize", "x.log", "--laser-pose", "0", "0", "-1.", "0", "-1.5e-1", "-.5E+0"]
    )
    assert vars(options)["localization.laser_pose"] == [0, 0, -1, 0, -0.15, -0.5]


def test_the_mesh_of_the_demo_is_scored_by_the_bundled_truth(demo, tmp_path, capsys):
    truth = bundled_recording() / "truth" / "surfaces.npz"
    arguments = [truth, demo / "mesh.ply", "--seen", demo / "cloud.ply", "--json", tmp_path / "score.json"]
    assert main(["evaluate", "surface", *map(str, arguments)]) == 0
    score = json.loads((tmp_path / "score.json").read_text())
    # What the published demo makes, with room for other versions of NumPy: 0.6 cm and 94 %.
    assert 0.001 < score["accuracy"] < 0.012
    assert score["at"][0]["threshold"] == 0.05
    assert 0.9 < score["at"][0]["f_score"] < 1
    assert score["topology"]["nonmanifold_edges"] == 0
    shown = capsys.readouterr().err
    assert f"{100 * score['accuracy']:.2f} cm" in shown
    assert f"{100 * score['at'][1]['f_score']:.2f} %" in shown


SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def shown_value(capsys, name):
    return next(line for line in capsys.readouterr().err.splitlines() if name in line).split("│")[2].strip()


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".glb"])
def test_a_mesh_5_cm_off_is_5_cm_off(tmp_path, capsys, ending):
    write_true_surface(tmp_path / "truth.npz", TrueSurface(SQUARE, TWO))
    write_mesh(tmp_path / f"mesh{ending}", Mesh(SQUARE + (0, 0, 0.05), TWO, np.zeros(2, int)))
    assert main(["evaluate", "surface", str(tmp_path / "truth.npz"), str(tmp_path / f"mesh{ending}")]) == 0
    assert shown_value(capsys, "accuracy") == "5.00 cm"


def test_the_truth_may_be_a_mesh(tmp_path, capsys):
    mesh = tmp_path / "mesh.ply"
    write_mesh(mesh, Mesh(SQUARE, TWO, np.zeros(2, int)))
    assert main(["evaluate", "surface", str(mesh), str(mesh)]) == 0
    assert shown_value(capsys, "F-score at 2 cm") == "100.00 %"


def test_a_score_is_refused_in_one_line(tmp_path, capsys):
    truth, mesh, flat = tmp_path / "truth.npz", tmp_path / "mesh.ply", tmp_path / "flat.ply"
    write_true_surface(truth, TrueSurface(SQUARE, TWO))
    write_mesh(mesh, Mesh(SQUARE, TWO, np.zeros(2, int)))
    write_mesh(flat, Mesh(SQUARE * 0, TWO, np.zeros(2, int)))
    write_cloud(tmp_path / "far.ply", Cloud(SQUARE + 50))
    assert "nowhere.npz" in refused(capsys, "evaluate", "surface", tmp_path / "nowhere.npz", mesh)
    assert "nowhere.ply" in refused(capsys, "evaluate", "surface", truth, tmp_path / "nowhere.ply")
    assert ".glb" in refused(capsys, "evaluate", "surface", truth, tmp_path / "mesh.blend")
    assert "mesh: no face has an area" in refused(capsys, "evaluate", "surface", truth, flat)
    said = refused(capsys, "evaluate", "surface", truth, mesh, "--seen", tmp_path / "far.ply")
    assert "nothing of it was seen" in said
    for read in (truth, mesh):
        assert "would replace" in refused(capsys, "evaluate", "surface", truth, mesh, "--json", read)


def relations_of_a_drive(folder, error):
    """A straight drive of 1 m a second as a TUM file, and relations of 10 s whose x is off by the errors (N,)."""
    stamps = np.arange(100.0)
    poses = np.column_stack([stamps, stamps, 0 * stamps, 0 * stamps, *[0 * stamps] * 3, 1 + 0 * stamps])
    np.savetxt(folder / "way.tum", poses)
    first = np.arange(len(error)) * 5.0
    zero = np.zeros_like(first)
    relations = np.column_stack([first, first + 10, 10 + np.array(error), *[zero] * 4, zero + np.radians(2)])
    np.savetxt(folder / "way.relations", relations)
    return folder / "way.relations", folder / "way.tum"


def test_a_trajectory_is_scored_by_relations(tmp_path, capsys):
    files = [str(file) for file in relations_of_a_drive(tmp_path, [0.1, 0.3])]
    assert main(["evaluate", "relations", *files, "--json", str(tmp_path / "score.json")]) == 0
    shown = capsys.readouterr().err
    assert "0.2000 +- 0.1000 m" in shown
    assert "2.000 +- 0.000 deg" in shown
    score = json.loads((tmp_path / "score.json").read_text())
    assert (score["relations"], score["missed"]) == (2, 0)
    assert score["translation_mean"] == pytest.approx(0.2)


def test_relations_or_trajectories_that_cannot_be_used_are_refused_in_one_line(tmp_path, capsys):
    relations, trajectory = relations_of_a_drive(tmp_path, [0.1])
    assert "no.relations" in refused(capsys, "evaluate", "relations", tmp_path / "no.relations", trajectory)
    assert "no.tum" in refused(capsys, "evaluate", "relations", relations, tmp_path / "no.tum")
    assert "way.relations" in refused(capsys, "evaluate", "relations", trajectory, relations)
    (tmp_path / "late.relations").write_text("1e6 1000010 10 0 0 0 0 0\n")
    said = refused(capsys, "evaluate", "relations", tmp_path / "late.relations", trajectory)
    assert "none of the relations" in said


def write_cloud_text(path):
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, np.random.default_rng(0).random((500, 3)) * (2, 2, 0.01))
    return path


@pytest.mark.parametrize(
    ("command", "source", "output"),
    [
        ("reconstruct", "same.ply", "same.ply"),
        ("reconstruct", "same.ply", "link.ply"),
        ("reconstruct", "mesh_wire.ply", "mesh.ply"),
        ("localize", "drive.log", "drive.log"),
        ("import", "drive.log", "drive.log"),
        ("import", "bag/drive.log", "bag"),
    ],
)
def test_a_result_never_replaces_what_is_read(tmp_path, capsys, command, source, output):
    file = tmp_path / source
    file.parent.mkdir(exist_ok=True)
    file.write_text("precious")
    (tmp_path / "link.ply").symlink_to(tmp_path / "same.ply")
    force = ["--force"] if command == "import" else []
    assert "would replace" in refused(capsys, command, file, "-o", tmp_path / output, *force)
    assert file.read_text() == "precious"


def test_a_result_never_replaces_a_file_of_the_bag_that_is_read(tmp_path, capsys):
    data = tmp_path / "bag" / "bag.mcap"
    data.parent.mkdir()
    data.write_text("precious")
    assert "would replace" in refused(capsys, "localize", tmp_path / "bag", "-o", data)


@pytest.mark.parametrize("name", ["config.yaml", "map.yaml"])
def test_a_run_never_replaces_the_settings_that_it_reads(tmp_path, capsys, name):
    settings = tmp_path / name
    settings.write_text("reconstruction:\n  theta: 2.5\n")
    said = refused(capsys, "run", bundled_recording(), "-o", tmp_path, "--config", settings)
    assert "would replace" in said


@pytest.mark.parametrize("content", [b"localization:\n  method: paper\n", b"\xff"], ids=["settings", "no text"])
def test_a_map_never_replaces_a_yaml_file_that_is_none(tmp_path, capsys, content):
    settings = tmp_path / "robot.yaml"
    settings.write_bytes(content)
    assert "is no map" in refused(capsys, "localize", tmp_path / "robot.log", "-o", tmp_path / "robot.tum")
    assert settings.read_bytes() == content


def test_a_result_never_replaces_a_folder(tmp_path, capsys):
    (tmp_path / "mesh.ply").mkdir()
    assert "is a folder" in refused(capsys, "reconstruct", tmp_path / "cloud.xyz", "-o", tmp_path / "mesh.ply")


def test_what_is_no_bag_is_not_replaced_even_if_asked_and_before_the_work(tmp_path, capsys):
    assert "is no bag" in refused(capsys, "import", "no.log", "-o", tmp_path, "--force")


def test_results_that_would_replace_each_other_are_refused(tmp_path, capsys):
    assert "two results" in refused(capsys, "localize", tmp_path / "drive.log", "-o", tmp_path / "way.png")
    assert "two results" in refused(capsys, "localize", tmp_path / "drive.log", "-o", tmp_path / "way.pgm")


@pytest.mark.parametrize("command", ["demo", "simulate"])
def test_a_place_for_results_that_is_a_file_is_refused_before_the_work(tmp_path, capsys, command):
    (tmp_path / "file").write_text("")
    said = refused(capsys, command, "-o", tmp_path / "file" / "more")
    assert "cannot be written" in said
    assert "cannot be written" in refused(capsys, "demo", "-o", tmp_path / "file")


def test_relations_that_cannot_be_read_are_refused_before_the_work(tmp_path, capsys):
    said = refused(capsys, "localize", tmp_path / "no.log", "--relations", tmp_path / "no.relations")
    assert "no.relations" in said


@pytest.mark.parametrize("name", ["out[/x].ply", "out[red].ply", "o" * 150 + ".ply"])
def test_the_path_of_a_result_is_shown_as_it_is(tmp_path, capsys, name):
    cloud = write_cloud_text(tmp_path / "cloud.xyz")
    assert main(["reconstruct", str(cloud), "-o", str(tmp_path / name)]) == 0
    assert f"mesh: {tmp_path / name}\n" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "localize", "reconstruct", "import"])
def test_a_link_to_itself_is_one_line_and_status_1(tmp_path, capsys, command):
    (tmp_path / "loop.log").symlink_to(tmp_path / "loop.log")
    assert "loop.log" in refused(
        capsys, command, tmp_path / "loop.log", *["-o", tmp_path / "new"] * (command == "import")
    )


@pytest.mark.parametrize("command", ["run", "localize", "merge", "reconstruct"])
def test_a_name_that_is_too_long_is_one_line_and_status_1(tmp_path, capsys, command):
    refused(capsys, command, tmp_path / ("o" * 300 + ".log"))


def test_a_cloud_that_gives_no_triangle_is_refused_with_advice(tmp_path, capsys):
    cloud = write_cloud_text(tmp_path / "cloud.xyz")
    assert "spacing" in refused(capsys, "reconstruct", cloud, "--spacing", "0.002", "--support-distance", "0.001")


def test_an_unknown_kind_of_mesh_is_refused_before_the_work(tmp_path, capsys):
    assert ".glb" in refused(capsys, "reconstruct", tmp_path / "cloud.ply", "-o", tmp_path / "mesh.blend")


@pytest.mark.parametrize(
    ("text", "said"),
    [("0 0 0\n1 0 0\n0 1 0\n", "3 distinct usable points"), ("1 1 1\n" * 500, "1 distinct usable points")],
    ids=["three points", "all equal"],
)
def test_a_cloud_without_a_surface_is_one_line_and_status_1(tmp_path, capsys, text, said):
    file = tmp_path / "cloud.xyz"
    file.write_text(text)
    assert said in refused(capsys, "reconstruct", file)


def test_a_log_without_a_scan_is_one_line_and_status_1(tmp_path, capsys):
    file = tmp_path / "empty.log"
    file.write_text("# nothing\nODOM 0 0 0 0 0 0 1.0 host 1.0\n")
    assert "empty.log" in refused(capsys, "localize", file)


def test_a_truncated_bag_is_one_line_and_status_1_or_what_is_left_of_it(tmp_path, capsys):
    whole = next(bundled_recording().glob("*.mcap")).read_bytes()
    for share in (0.0, 0.001, 0.5):
        file = tmp_path / f"cut_{share}.mcap"
        file.write_bytes(whole[: int(share * len(whole))])
        if main(["localize", str(file), "-o", str(tmp_path / "way.tum")]) == 0:
            assert share == 0.5
            assert 0 < len(read_tum(tmp_path / "way.tum")) < 6000
        else:
            assert share < 0.5


def test_a_folder_that_cannot_be_written_is_one_line_and_status_1(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    cloud = tmp_path / "cloud.xyz"
    np.savetxt(cloud, np.random.default_rng(0).random((500, 3)))
    assert "cannot be written" in refused(capsys, "reconstruct", cloud, "-o", tmp_path / "file" / "mesh.ply")


def two_sweeps(tmp_path, *, ending=".npz", scale=1.0):
    """Files of two sweeps of a room with 1 cm of noise, and where the second is as seen from the first."""
    rectangles, rng = simulated_sweeps.furnished_room(), np.random.default_rng(0)
    stops = [simulated_sweeps.stop(5.0, 3.0, 10.0), simulated_sweeps.stop(5.6, 3.2, 25.0)]
    files = [tmp_path / f"sweep_{number}{ending}" for number in range(2)]
    for file, at in zip(files, stops, strict=True):
        write_cloud(file, Cloud(scale * simulated_sweeps.sweep(rectangles, at, rng)))
    return files, se3.inverse(stops[0]) @ stops[1]


@pytest.mark.parametrize("method", ["gicp", "kiss", "paper"])
def test_sweeps_are_merged_from_first_guesses_that_are_off(tmp_path, method):
    files, T = two_sweeps(tmp_path)
    guess = T @ se3.from_xyz_rpy([0.1, -0.1, 0, 0, 0, 0.05])
    write_tum(tmp_path / "guess.tum", Trajectory.from_matrices([10.0, 20.0], [np.eye(4), guess]))
    target = tmp_path / "merged.ply"
    arguments = [*files, "-o", target, "--poses", tmp_path / "guess.tum", "--method", method]
    assert main(["merge", *map(str, arguments)]) == 0
    poses = read_tum(tmp_path / "poses.tum")
    assert poses.stamps.tolist() == [10.0, 20.0]
    assert np.linalg.norm(poses.positions[1] - T[:3, 3]) < 0.01
    cloud = read_cloud(target)
    assert len(cloud) == 2 * 36200
    assert np.unique(cloud.sensor.round(6), axis=0) == pytest.approx(poses.positions, abs=1e-5)


@pytest.mark.parametrize("ending", [".ply", ".pcd", ".xyz"])
def test_sweeps_are_merged_without_first_guesses(tmp_path, ending, monkeypatch):
    files, T = two_sweeps(tmp_path, ending=ending)
    monkeypatch.chdir(tmp_path)
    assert main(["merge", *map(str, files)]) == 0
    assert len(read_cloud(tmp_path / "sweep_0_merged.ply")) == 2 * 36200
    assert np.linalg.norm(read_tum(tmp_path / "poses.tum").positions[1] - T[:3, 3]) < 0.01


def test_sweeps_in_millimetres_are_refused_with_advice_and_merged_with_it(tmp_path, capsys):
    files, _ = two_sweeps(tmp_path, scale=1000.0)
    assert "set scale, such as 0.001" in refused(capsys, "merge", *files, "-o", tmp_path / "m.ply")
    assert main(["merge", *map(str, files), "-o", str(tmp_path / "m.ply"), "--scale", "0.001"]) == 0
    assert np.ptp(read_cloud(tmp_path / "m.ply").points, axis=0).max() < 20


def test_sweeps_that_cannot_be_used_are_refused_in_one_line(tmp_path, capsys):
    files, T = two_sweeps(tmp_path)
    target = tmp_path / "m.ply"
    empty = tmp_path / "empty.npz"
    write_cloud(empty, Cloud(np.full((5, 3), np.nan)))
    assert "empty.npz: none of the 5 points" in refused(capsys, "merge", files[0], empty, "-o", target)
    write_tum(tmp_path / "one.tum", Trajectory.from_matrices([0.0], [T]))
    assert "1 poses for 2 sweeps" in refused(capsys, "merge", *files, "-o", target, "--poses", tmp_path / "one.tum")
    (tmp_path / "bent.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 9\n")
    assert "unit length" in refused(capsys, "merge", *files, "-o", target, "--poses", tmp_path / "bent.tum")
    content = files[0].read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    assert "cut.npz" in refused(capsys, "merge", tmp_path / "cut.npz", files[1], "-o", target)
    assert "ending" in refused(capsys, "merge", *files, "-o", tmp_path / "m.glb")
    assert "would replace" in refused(capsys, "merge", *files, "-o", files[1])
    assert not target.exists()


def test_sweeps_that_do_not_overlap_are_refused_in_one_line(tmp_path, capsys):
    rng = np.random.default_rng(1)
    rectangles, stops = simulated_sweeps.two_rooms(rng)
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for file, at in zip(files, stops, strict=True):
        write_cloud(file, Cloud(simulated_sweeps.sweep(rectangles, at, rng)))
    assert "no sweep could be laid on another" in refused(capsys, "merge", *files, "-o", tmp_path / "m.ply")


def test_the_sweeps_of_a_simulated_robot_are_merged_from_its_bag(tmp_path):
    arguments = ["--setup", "sweeping", "--horizontal-every", "9", "-o", str(tmp_path / "bag")]
    assert main(["simulate", *arguments]) == 0
    quickly = ["--search", "0", "--search-angle", "0"]
    assert main(["merge", str(tmp_path / "bag"), "-o", str(tmp_path / "m.ply"), *quickly]) == 0
    assert len(read_tum(tmp_path / "poses.tum")) == 6


@needs(DATA / "sweeps" / "pcl_room")
@pytest.mark.parametrize("method", ["gicp", "kiss", "paper"])
def test_the_recorded_room_is_merged_from_odometry(tmp_path, method):
    files = [str(DATA / "sweeps" / "pcl_room" / f"room_scan{number}.pcd") for number in (1, 2)]
    driven = se3.from_xyz_rpy([1.79, 0.72, 0.0, 0.0, 0.0, 0.6931])
    write_tum(tmp_path / "guess.tum", Trajectory.from_matrices([0.0, 1.0], [np.eye(4), driven]))
    arguments = ["--poses", str(tmp_path / "guess.tum"), "-o", str(tmp_path / "m.ply"), "--method", method]
    assert main(["merge", *files, *arguments]) == 0
    poses = read_tum(tmp_path / "poses.tum")
    # The truth is known to the centimetre, with a level robot.
    assert np.linalg.norm(poses.positions[1] - [1.98, 0.06, 0.016]) < 0.025
    assert np.degrees(abs(poses.planar()[1, 2] - 0.710)) < 0.3


def test_the_command_runs_as_a_process_of_its_own():
    shown = subprocess.run(
        [sys.executable, "-m", "g2_recon.cli", "--version"], capture_output=True, text=True, check=True
    )
    assert shown.stdout.startswith("g2-recon 0.")
