# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from g2_recon.config import ReconstructionConfig
from g2_recon.errors import InputError
from g2_recon.evaluation.surface import score_surface
from g2_recon.geometry.cloud import Cloud, Piece
from g2_recon.geometry.edges import edges_of, half_edge_numbers
from g2_recon.geometry.intersections import crossing_pairs
from g2_recon.geometry.mesh import TrueSurface
from g2_recon.reconstruction import growing_joins
from g2_recon.reconstruction.collected_cloud import CollectedCloud, Part
from g2_recon.reconstruction.growing import GrowingReconstruction
from g2_recon.reconstruction.reconstructor import reconstruct

CONFIG = ReconstructionConfig()
LENGTH, WIDTH, HEIGHT = 16.0, 3.0, 2.5
BOX = np.array([[x, y, z] for x in (0, LENGTH) for y in (0, WIDTH) for z in (0, HEIGHT)], float)
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def corridor(begin, end, seed=0, per_metre=800):
    """Floor, ceiling and both long sides of a corridor of 16 m, from `begin` to `end`, noise 1 cm, seen from inside."""
    rng = np.random.default_rng(seed)
    count = int(per_metre * (end - begin))
    points = rng.random((count, 3)) * (end - begin, WIDTH, HEIGHT) + (begin, 0, 0)
    side = rng.integers(0, 4, count)
    points[side == 0, 2], points[side == 1, 2] = 0, HEIGHT
    points[side == 2, 1], points[side == 3, 1] = 0, WIDTH
    sensor = np.column_stack([points[:, 0], np.full(count, WIDTH / 2), np.full(count, 1.0)])
    return Cloud(points + rng.normal(0, 0.01, points.shape), sensor)


PIECES = [corridor(at, at + 2, seed=at) for at in range(0, 16, 2)]


def parts(clouds, versions=None):
    return {number: Part(0 if versions is None else versions[number], cloud) for number, cloud in enumerate(clouds)}


def grown(clouds, config=CONFIG):
    """The reconstruction after the clouds came one after the other."""
    growing = GrowingReconstruction(config)
    for count in range(1, len(clouds) + 1):
        result = growing.update(parts(clouds[:count]))
    return result


@pytest.fixture(scope="module")
def after_all():
    return grown(PIECES)


def of_submap(mesh, name):
    """The corners of the faces of a submap, in an order of their own."""
    corners = mesh.vertices[mesh.faces[mesh.submap == name]].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


def assert_sound(mesh):
    assert np.isfinite(mesh.vertices).all()
    _, face_edges = edges_of(mesh.faces, len(mesh.vertices))
    assert np.bincount(half_edge_numbers(mesh.faces, face_edges).ravel()).max() <= 1
    assert not len(crossing_pairs(mesh.vertices, mesh.faces))


def test_what_comes_at_once_is_reconstructed_as_offline():
    live, offline = GrowingReconstruction(CONFIG).update(parts(PIECES)), reconstruct(whole_corridor(), CONFIG)
    for name in ("vertices", "faces", "submap"):
        np.testing.assert_array_equal(getattr(live.mesh, name), getattr(offline.mesh, name))
    assert live.quantization_error == offline.quantization_error


def whole_corridor():
    return Cloud(*(np.concatenate([getattr(piece, name) for piece in PIECES]) for name in ("points", "sensor")))


def f5_of(result):
    truth = TrueSurface(BOX, np.concatenate([SIDES[:, :3], SIDES[:, [0, 2, 3]]]), whole_corridor().points)
    return score_surface(truth, result.mesh.vertices, result.mesh.faces, thresholds=[0.05]).at[0].f_score


def test_what_came_piece_by_piece_scores_within_half_a_point_of_f5_of_the_offline_mesh(after_all):
    """0.5 points: the issue."""
    offline = f5_of(reconstruct(whole_corridor(), CONFIG))
    assert offline > 0.97
    assert f5_of(after_all) == pytest.approx(offline, abs=0.005)


def test_the_mesh_that_grew_is_manifold_oriented_and_without_crossings(after_all):
    assert_sound(after_all.mesh)


def test_submaps_far_from_new_points_stay_as_they_are():
    growing = GrowingReconstruction(CONFIG)
    before = growing.update(parts(PIECES[:7])).mesh
    after = growing.update(parts(PIECES)).mesh
    # New points begin at 14 m; a cluster is up to 2 m wide.
    far = [name for name in np.unique(before.submap) if before.vertices[before.faces[before.submap == name]].max() < 10]
    assert len(far) >= 20
    for name in far:
        np.testing.assert_array_equal(of_submap(after, name), of_submap(before, name))
    assert after.vertices[:, 0].max() > 15.5


def test_what_is_joined_around_changes_only_is_as_if_all_had_been_joined(monkeypatch):
    changed_only, compared = growing_joins._changed_only, []

    def compare(state, config):
        some = changed_only(state, config)
        if some is not None and len(state.neurons.places[state.loose]):
            faces, sheet = growing_joins._joined(state, growing_joins._all_of(state), config)
            assert {*map(frozenset, faces.tolist())} == {*map(frozenset, some[0].tolist())}
            middles, others = (each.vertices[each.faces].mean(axis=1) for each in (sheet, some[1]))
            off = cKDTree(middles).query(others)[0]
            compared.append((len(middles) - len(others), np.count_nonzero(off > 0.001), off.max()))
        return some

    monkeypatch.setattr(growing_joins, "_changed_only", compare)
    # Pieces of 1 m, back and forth, so that holes are closed and borders moved in the middle, too.
    order = [0, 1, 2, 3, 4, 5, 8, 9, 10, 11, 12, 13, 14, 15, 6, 7]
    mesh = grown([corridor(at, at + 1, seed=at) for at in order]).mesh
    assert_sound(mesh)
    assert len(compared) >= 5
    assert all(more == moved == 0 and farthest < 1e-6 for more, moved, farthest in compared), compared


def test_the_result_does_not_depend_on_the_workers(after_all):
    other = grown(PIECES, replace_workers(3))
    np.testing.assert_array_equal(after_all.mesh.vertices, other.mesh.vertices)
    np.testing.assert_array_equal(after_all.mesh.submap, other.mesh.submap)


def replace_workers(count):
    return CONFIG.model_copy(update={"workers": count})


def test_a_piece_that_is_moved_leaves_nothing_of_its_old_place():
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts(PIECES))
    lifted = Cloud(PIECES[7].points + (0, 0, 6.0), PIECES[7].sensor + (0, 0, 6.0))
    mesh = growing.update(parts([*PIECES[:7], lifted], [0] * 7 + [1])).mesh
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    below = middles[middles[:, 2] < 4]
    # The others end at 14 m; a border reaches at most a cell of 0.2 m beyond its data.
    assert below[:, 0].max() < 14.2
    assert middles[:, 2].max() > 8.4
    assert_sound(mesh)


def test_a_piece_that_is_gone_is_gone_from_the_mesh():
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts(PIECES))
    assert growing.update(parts(PIECES[:7])).mesh.vertices[:, 0].max() < 14.3


def test_of_a_piece_that_is_gone_no_submap_is_left():
    growing = GrowingReconstruction(CONFIG)
    before = growing.update(parts(PIECES[:4]))
    growing.update(parts([*PIECES[:4], corridor(20, 22)]))
    after = growing.update(parts(PIECES[:4]))
    assert after.clusters == before.clusters
    for name in ("vertices", "faces", "submap"):
        np.testing.assert_array_equal(getattr(after.mesh, name), getattr(before.mesh, name))


def test_pieces_that_are_moved_again_and_again_leave_nothing(after_all):
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts(PIECES))
    rng = np.random.default_rng(0)
    for version in range(1, 9):
        off = rng.uniform(-0.15, 0.15, 3) if version < 8 else np.zeros(3)
        moved = [Cloud(piece.points + off, piece.sensor + off) for piece in PIECES[5:]]
        result = growing.update(parts([*PIECES[:5], *moved], [0] * 5 + [version] * 3))
    assert result.clusters < 1.5 * after_all.clusters
    assert len(result.mesh.faces) == pytest.approx(len(after_all.mesh.faces), rel=0.05)
    assert f5_of(result) == pytest.approx(f5_of(after_all), abs=0.005)


def test_when_a_cloud_without_sensors_is_gone_all_sides_are_told_by_the_sensors_again():
    growing = GrowingReconstruction(CONFIG)
    pieces = PIECES[:4]
    before = growing.update(parts(pieces))
    growing.update(parts([*pieces, Cloud(corridor(20, 22).points)]))
    after = growing.update(parts(pieces))
    middle = np.array([4.0, WIDTH / 2, HEIGHT / 2])
    for mesh in (before.mesh, after.mesh):
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inward = np.einsum("ni,ni->n", normals, (middle - corners.mean(axis=1)) * (0, 1, 1)) > 0
        assert inward.mean() > 0.99


def test_points_that_are_added_to_a_piece_come_to_those_before():
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts(PIECES[:5]))
    longer = Cloud(*(np.concatenate([getattr(PIECES[n], name) for n in (4, 5)]) for name in ("points", "sensor")))
    result = growing.update(parts([*PIECES[:4], longer]))
    assert result.mesh.vertices[:, 0].max() > 11.5
    assert result.points + sum(result.left_out.values()) == sum(len(piece) for piece in PIECES[:6])


def test_a_piece_that_is_sent_again_with_the_same_points_changes_nothing():
    growing = GrowingReconstruction(CONFIG)
    before = growing.update(parts(PIECES))
    again = [replace(piece, points=piece.points.copy()) for piece in PIECES]
    assert growing.update(parts(again, [1] * len(again))) is before


def test_what_was_surface_before_all_is_made_anew_leaves_no_trace():
    """Most points go, and some of those that stay are no surface without them."""
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts([PIECES[4].select(np.arange(1000)), PIECES[5].select(np.arange(400))]))
    left = [PIECES[4].select(np.arange(240)), PIECES[5].select(np.arange(400))]
    mesh = growing.update(parts(left, [1, 0])).mesh
    whole = Cloud(*(np.concatenate([getattr(cloud, name) for cloud in left]) for name in ("points", "sensor")))
    assert len(mesh.faces) == len(reconstruct(whole, CONFIG).mesh.faces)
    assert_sound(mesh)


def test_a_submap_keeps_its_number_while_its_data_grows():
    growing = GrowingReconstruction(CONFIG)
    before = growing.update(parts(PIECES[:4])).mesh
    after = growing.update(parts(PIECES[:5])).mesh
    # At most those at the end of the corridor are new.
    assert len(np.intersect1d(before.submap, after.submap)) >= 0.8 * len(np.unique(before.submap))
    assert after.submap.max() > before.submap.max()


def test_too_few_points_are_refused_and_the_next_update_begins_anew():
    growing = GrowingReconstruction(CONFIG)
    with pytest.raises(InputError, match="distinct usable points"):
        growing.update(parts([PIECES[0].select(np.arange(5))]))
    whole = growing.update(parts([PIECES[0]]))
    np.testing.assert_array_equal(whole.mesh.vertices, reconstruct(PIECES[0], CONFIG).mesh.vertices)


def test_clouds_without_sensors_grow_too():
    clouds = [Cloud(piece.points) for piece in PIECES[:3]]
    result = grown(clouds)
    assert result.mesh.vertices[:, 0].max() > 5.5
    assert_sound(result.mesh)


def test_points_that_are_not_finite_or_on_the_robot_are_left_out():
    points, sensor = PIECES[5].points.copy(), PIECES[5].sensor.copy()
    points[:3] = np.nan
    sensor[3:10] = points[3:10] + 0.01
    growing = GrowingReconstruction(CONFIG)
    growing.update(parts(PIECES[:5]))
    result = growing.update(parts([*PIECES[:5], Cloud(points, sensor)]))
    assert result.left_out["not finite or nearer to the sensor than min_sensor_distance"] == 10
    assert np.isfinite(result.mesh.vertices).all()


# Without shrinking, which would take minutes.
@settings(max_examples=10, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 40), st.floats(-0.5, 0.5)), min_size=1, max_size=4))
def test_pieces_that_come_go_and_move_in_any_order_make_a_sound_mesh_or_one_clear_error(steps):
    """Each step puts part of a piece to another place, or, with 0 points, takes it away."""
    growing, now = GrowingReconstruction(CONFIG), {}
    for version, (number, tenths, shift) in enumerate(steps):
        cloud = PIECES[number].select(np.arange(40 * tenths))
        now[number] = Part(version, Cloud(cloud.points + (0, 0, shift), cloud.sensor + (0, 0, shift)))
        if not tenths:
            del now[number]
        try:
            result = growing.update(now)
        except InputError:
            continue
        assert_sound(result.mesh)
        assert len(np.unique(result.mesh.submap)) <= result.clusters


def test_what_is_collected_tells_what_it_consists_of():
    collected = CollectedCloud()
    collected.add(PIECES[0])
    collected.add(PIECES[1], Piece(1, 7))
    collected.add(PIECES[2], Piece(1, 7))
    before = collected.parts()
    assert [len(part.cloud) for part in before.values()] == [len(PIECES[0]), len(PIECES[1]) + len(PIECES[2])]
    collected.add(PIECES[3], Piece(1, 7, 1))
    after = collected.parts()
    assert [one.version == other.version for one, other in zip(before.values(), after.values(), strict=True)] == [
        True,
        False,
    ]


def test_points_cleared_and_sent_again_are_another_part():
    collected = CollectedCloud()
    collected.add(PIECES[0])
    before = collected.parts()[None].version
    collected.clear()
    collected.add(PIECES[0])
    assert collected.parts()[None].version != before
