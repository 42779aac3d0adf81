"""Captures that are mapped in parts: where these lie, and that what comes out is one model of all."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.colmap.chunks import Processes
from colmap_inertial.colmap.context import RunContext
from colmap_inertial.colmap.loops.closure import LONGEST, LoopClosure, SubmapOverlap, merge_overlaps
from colmap_inertial.colmap.mapping import mapper as mapping, submaps
from colmap_inertial.colmap.mapping.submaps import MappedRun, join_runs, merge_parts, place_parts, runs, split_capture
from colmap_inertial.colmap.parts import write_part_database
from colmap_inertial.core.geometry import so3_exp
from colmap_inertial.core.options import MappingOptions
from colmap_inertial.model.submodels.graph import (
    PLACEMENT,
    Convergence,
    Equations,
    Placements,
    SimilarityConstraint,
    minimise_placements,
)
from colmap_inertial.model.submodels.matches import Submodel, constrain_by_points, find_common_features
from tests.colmap.loops.test_closure import FRAMES, NAMES, make

#: Runs of the ring's images.
PARTS = [(0, 18), (12, 30), (24, 42), (36, 48)]


def test_runs_hold_every_image_and_share_some_with_the_next(subtests):
    for count in (1001, 1040, 2000, 3601, 12345):
        with subtests.test(count=count):
            found = runs(count, longest=400, shared=40)
            assert found[0][0] == 0 and found[-1][1] == count
            lengths = [end - begin for begin, end in found]
            assert max(lengths) <= 400 + 1 and max(lengths) - min(lengths) <= 1 + 1
            for (_, end), (begin, _) in itertools.pairwise(found):
                assert end - begin == 40
            # one fewer would not do
            assert (len(found) - 1) * 360 + 40 < count


@pytest.mark.parametrize(
    ("count", "observations", "refined", "longest", "shared"),
    [
        (299, 1100, False, 299, 0),
        (300, 160, False, 200, 40),
        (2000, 550, False, 200, 40),
        (500, 700, False, 157, 31),
        (500, 1100, False, 100, 20),
        (500, 5000, False, 100, 20),
        (500, 0, False, 200, 40),
        (1000, 1100, True, 1000, 0),
        (1001, 1100, True, 400, 40),
    ],
)
def test_a_capture_is_split_by_its_observations(count, observations, refined, longest, shared):
    """Parts hold 110,000 observations and 100 to 200 images, a fifth of them the next one's, too."""
    graph = SimpleNamespace(num_observations_for_image=lambda number: observations + (-1) ** number)
    capture = SimpleNamespace(
        names=[f"{k}" for k in range(count)],
        pipeline=SimpleNamespace(ba_refine_focal_length=refined),
        cache=SimpleNamespace(correspondence_graph=graph, images=dict.fromkeys(range(count if observations else 0))),
    )
    found = split_capture(capture)
    assert found[0][0] == 0 and found[-1][1] == count
    assert max(end - begin for begin, end in found) <= longest + 1
    assert {end - begin for (_, end), (begin, _) in itertools.pairwise(found)} == ({shared} if shared else set())
    assert len(found) == (1 if not shared else -(-(count - shared) // (longest - shared)))


def similarity(scale=1.0, turn_rad=(0.0, 0, 0), translation=(0.0, 0, 0)):
    import pycolmap

    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(so3_exp(np.array(turn_rad))), np.array(translation, dtype=float))


def random_similarity(rng, scale=0.3):
    return similarity(float(np.exp(scale * rng.standard_normal())), rng.standard_normal(3), 5 * rng.standard_normal(3))


def constraint(rng, world, first: int, second: int, off=None, noise: float = 0.0, count: int = 200):
    """Points of two parts whose places are known; ``off``: how the second one lies wrongly in the first one."""
    points = world[first] * (10 * rng.random((count, 3)))
    in_first, in_second = (
        world[k].inverse() * points + noise * rng.standard_normal((count, 3)) for k in (first, second)
    )
    in_first = in_first if off is None else off * in_first
    similar = world[first].inverse() * world[second]
    similar = similar if off is None else off * similar
    away = (3 + 2 * rng.random(count)) / world[first].scale
    start = (similar.scale, similar.rotation.matrix())
    return (
        SimilarityConstraint.fitted(first, second, (in_first, in_second), away, start=start),
        in_first,
        in_second,
        away,
    )


def placements(world):
    return Placements(
        scale=np.array([one.scale for one in world]),
        rotation=np.array([one.rotation.matrix() for one in world]),
        translation=np.array([one.translation for one in world]),
        change=np.zeros(7 * len(world)),
    )


def test_a_constraint_has_the_squares_of_its_points():
    rng = np.random.default_rng(4)
    world = [random_similarity(rng), random_similarity(rng)]
    tie, in_first, in_second, away = constraint(rng, world, 0, 1, noise=0.01)
    assert tie.squares > 0
    for size in (1e-3, 1e-2):
        state = placements(world).moved(size * rng.standard_normal(14))
        similar = state.similarity(0).inverse() * state.similarity(1)
        expected = np.sum(((in_first - similar * in_second) / away[:, None]) ** 2)
        assert tie.squares + tie.misfit(state) == pytest.approx(expected, rel=3 * size)


def test_a_constraint_that_counts_less_counts_less_in_all_it_says():
    rng = np.random.default_rng(5)
    world = [random_similarity(rng), random_similarity(rng)]
    tie, *_ = constraint(rng, world, 0, 1, noise=0.02)
    state = placements(world).moved(1e-2 * rng.standard_normal(14))
    quarter = tie.weighted(0.25)
    assert quarter.squares == pytest.approx(0.25 * tie.squares) and quarter.squares > 0
    assert quarter.misfit(state) == pytest.approx(0.25 * tie.misfit(state))
    assert quarter.equations == pytest.approx(0.25 * tie.equations)


def test_the_derivatives_of_a_constraint_are_those_of_its_residual():
    rng = np.random.default_rng(6)
    world = [random_similarity(rng), random_similarity(rng)]
    tie, *_ = constraint(rng, world, 0, 1, similarity(1.1, (0.1, 0.2, 0), (0.3, 0, 0)))
    state = placements(world)
    _, by = tie.residual(state)
    for k, step in enumerate(1e-6 * np.eye(14)):
        (after, _), (before, _) = (tie.residual(state.moved(sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(by[:, k], (after - before) / 2e-6, atol=1e-4 * (1 + np.abs(by[:, k]).max()))


def test_many_parts_and_loops_are_placed_together():
    rng = np.random.default_rng(5)
    world = [similarity(), *(random_similarity(rng, 0.1) for _ in range(11))]
    pairs = [(k, k + 1) for k in range(11)] + [(a, b) for a in range(12) for b in range(a + 2, 12) if (a + b) % 2]
    ties = [constraint(rng, world, a, b, noise=0.01, count=500)[0] for a, b in pairs]
    found = place_parts(12, ties)
    for k, true in enumerate(world):
        np.testing.assert_allclose(found.similarity(k).matrix(), true.matrix(), atol=0.02)
    assert len(ties) > 30 and all(tie.info.shape == (7, 7) for tie in ties)


def test_parts_are_placed_where_they_are_and_a_loop_takes_drift_out():
    rng = np.random.default_rng(2)
    world = [similarity(), *(random_similarity(rng) for _ in range(5))]
    exact = place_parts(6, [constraint(rng, world, k, k + 1)[0] for k in range(5)])
    for k, true in enumerate(world):
        np.testing.assert_allclose(exact.similarity(k).matrix(), true.matrix(), atol=1e-9)
    # each tie turns, stretches and moves a little more
    drift = similarity(1.01, (0.0, 0.01, 0.005), (0.02, 0.0, 0.01))
    drifted = [constraint(rng, world, k, k + 1, drift)[0] for k in range(5)]

    def off(ties):
        found = place_parts(6, ties)
        probe = rng.standard_normal((20, 3))
        return max(
            float(np.linalg.norm(found.similarity(k) * (true.inverse() * probe) - probe, axis=1).max())
            for k, true in enumerate(world)
        )

    chained = off(drifted)
    # what lies half a lap away is as far off as half of it drifts
    assert chained > 0.3 and off([*drifted, constraint(rng, world, 0, 5)[0]]) < 0.6 * chained


def test_the_limit_of_one_go_is_colmap_s_own():
    import pycolmap

    assert pycolmap.BundleAdjustmentOptions().ceres.max_num_images_direct_sparse_cpu_solver == LONGEST


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    """The matches of a lap, and COLMAP's models of runs of its images, each in its own units and axes."""
    import pycolmap

    made = make(tmp_path_factory.mktemp("ring"), drift=1.0, wider=1.0, true_focal_px=200.0)
    parts = []
    for begin, end in PARTS:
        made.options.image_names = NAMES[begin:end]
        out = tmp_path_factory.mktemp("part")
        pycolmap.set_random_seed(0)
        (model,) = pycolmap.incremental_mapping(str(made.database), str(out), str(out), options=made.options).values()
        assert model.num_reg_images() == end - begin
        parts.append(MappedRun(model=model, begin=begin, end=end))
    made.options.image_names = []
    return made, parts


def error_m(ring, model) -> float:
    return replace(ring, model=model).error_m()


def test_parts_become_one_model_that_is_as_good_as_one_made_in_one_go(ring):
    ring, parts = ring
    (whole,), seams = join_runs(ring.capture(), parts, near=4, loops=True)
    assert len(seams) == 4 and all(seam.joined and seam.agree > 0.9 for seam in seams)
    assert sorted(whole.image(i).name for i in whole.reg_image_ids()) == NAMES
    assert [whole.image(i).name for i in whole.reg_image_ids()] == [NAMES[i - 1] for i in whole.reg_image_ids()]
    assert error_m(ring, whole) < 0.008
    # there are 1500 points, and each is one, whichever parts saw it
    assert 1490 <= whole.num_points3D() <= 1500


def test_ends_of_a_lap_are_placed_by_their_matches_where_these_may_be_believed(ring):
    ring, parts = ring
    far, near = (submaps.find_ties(ring.capture(), parts, nearest=nearest).keys() for nearest in (None, 4))
    assert near == {(0, 1), (1, 2), (2, 3)} and far == near | {(0, 3)}


def test_points_that_contradict_most_others_do_not_place_parts(ring):
    ring, (first, second, *_) = ring
    rng = np.random.default_rng(3)
    submodels = [Submodel(first.model), Submodel(second.model)]
    views = find_common_features(submodels)[0, 1]
    assert [name for name, _, _ in views] == NAMES[second.begin : first.end]
    some = [(a, b, f.copy()) for a, b, f in views]
    for _, _, features in some:
        features[::10, 1] = rng.permutation(features[::10, 1])
    good = constrain_by_points(submodels, (0, 1), some)
    state = Placements.at_origin(np.ones(2))
    good.attach(state, 1, scaled=True)
    # the shared images lie where both parts have them
    for name, _, _ in views:
        here, there = (submodel.images[name].projection_center() for submodel in submodels)
        assert np.linalg.norm(state.similarity(1) * there - here) < 0.03 * np.linalg.norm(here - good.image)
    for _, _, features in some:
        features[:, 1] = rng.permutation(features[:, 1])
    assert constrain_by_points(submodels, (0, 1), some) is None


def test_an_image_that_two_parts_share_is_of_the_one_that_knows_more_on_both_sides(ring):
    ring, parts = ring
    placed = placements([similarity(translation=(1000.0 * k, 0, 0)) for k in range(2)])
    whole, part_of = merge_parts(parts[:2], placed, NAMES)
    centres = {whole.image(k).name: whole.image(k).projection_center() for k in whole.reg_image_ids()}
    far = {name for name, centre in centres.items() if centre[0] > 500}
    assert set(centres) == set(NAMES[:30])
    assert far == set(NAMES[15:30])
    assert {NAMES[number - 1] for number, k in part_of.items() if k} == far


def test_parts_that_have_nothing_in_common_stay_apart(ring):
    ring, parts = ring
    short = [parts[2], parts[0]]
    found, seams = join_runs(ring.capture(), short, near=4, loops=False)
    assert [model.num_reg_images() for model in found] == [18, 18] and not seams
    assert all(model is part.model for model, part in zip(found, short, strict=True))


def fits(agree: dict[tuple[int, int], float], nearest, farthest: int = 40) -> SubmapOverlap:
    """What comes of an adjustment after which each seam agrees so well."""
    asked = {seam: share for seam, share in agree.items() if seam in nearest}
    seams = {
        s: LoopClosure(pairs=9, images=(NAMES[0], NAMES[s[1]]), agree=a, joined=a >= 0.5) for s, a in asked.items()
    }
    return SubmapOverlap(seams=seams, farthest=dict.fromkeys(seams, farthest), kept=1.0)


def test_parts_of_which_no_seam_fits_stay_as_they_are(ring, monkeypatch):
    ring, parts = ring
    asked = []

    def close(*_, nearest, **__):
        asked.append(set(nearest))
        return fits({(0, 1): 0.3, (1, 2): 0.2, (2, 3): 0.1, (0, 3): 0.0}, nearest, 2)

    monkeypatch.setattr(submaps, "merge_overlaps", close)
    found, seams = join_runs(ring.capture(), parts, near=4, loops=True)
    assert [model.num_reg_images() for model in found] == [18, 18, 18, 12]
    assert all(any(model is part.model for part in parts) for model in found)
    # the worst of all that are left each time
    assert len(asked) == 4 and [seam.agree for seam in seams] == [0.0, 0.1, 0.2, 0.3]


def test_a_loop_that_does_not_fit_is_forgotten_and_all_else_is_joined(ring, monkeypatch):
    ring, parts = ring
    asked, placed = [], []

    def close(*_, nearest, **__):
        asked.append(dict(nearest))
        return (
            fits({(0, 1): 1.0, (1, 2): 0.4, (2, 3): 1.0, (0, 3): 0.3}, nearest)
            if len(asked) == 1
            else fits({(0, 1): 1.0, (1, 2): 0.9, (2, 3): 1.0, (0, 3): 0.0}, nearest)
        )

    def place(count, ties):
        placed.append({(tie.first, tie.second) for tie in ties})
        return place_parts(count, ties)

    monkeypatch.setattr(submaps, "merge_overlaps", close)
    monkeypatch.setattr(submaps, "place_parts", place)
    (whole,), seams = join_runs(ring.capture(), parts, near=4, loops=True)
    assert placed[0] - placed[1] == {(0, 3)} and len(asked) == 2 and (0, 3) not in asked[1]
    assert whole.num_reg_images() == FRAMES
    assert [seam.joined for seam in seams] == [False, True, True, True]


def test_of_neighbours_that_do_not_fit_first_pairs_far_apart_in_time_are_not_believed(ring, monkeypatch):
    ring, parts = ring
    asked = []

    def close(*_, nearest, **__):
        asked.append(nearest.get((0, 1), "left out"))
        return fits({(0, 1): 0.2, (1, 2): 1.0, (2, 3): 1.0, (0, 3): 1.0}, nearest, 40 if len(asked) == 1 else 4)

    monkeypatch.setattr(submaps, "merge_overlaps", close)
    (whole,), _ = join_runs(ring.capture(), parts, near=4, loops=True)
    assert asked == [None, 4, "left out"] and whole.num_reg_images() == FRAMES


@pytest.mark.parametrize(("turn_rad", "models", "not_joined"), [(0.9, [48], 1), (1.2, [12, 42], 2)])
def test_a_part_that_lies_wrong_is_not_averaged_away(ring, monkeypatch, turn_rad, models, not_joined):
    """However often it is placed, the last part is turned; where the adjustment does not mend that, it is by itself."""
    ring, parts = ring
    bad = similarity(1.0, (0, turn_rad, 0), (3, 1, 2))

    members, among = [], submaps.among

    def inside(ties, group):
        members[:] = group
        return among(ties, group)

    def place(count, ties):
        placed = place_parts(count, ties)
        lie = [placed.similarity(k) for k in range(count)]
        return placements([*lie[:-1], bad * lie[-1]]) if members[-1] == 3 else placed

    monkeypatch.setattr(submaps, "among", inside)
    monkeypatch.setattr(submaps, "place_parts", place)
    found, seams = join_runs(ring.capture(), parts, near=4, loops=True)
    assert sorted(model.num_reg_images() for model in found) == models
    assert all(error_m(ring, model) < 0.008 for model in found if model.num_reg_images() == FRAMES)
    assert sum(not seam.joined for seam in seams) == not_joined


def test_the_largest_part_s_camera_is_that_of_all(ring, monkeypatch):
    import pycolmap

    ring, parts = ring
    asked = []

    def close(capture, whole, *_, nearest, **__):
        asked.append(whole)
        return fits(dict.fromkeys(nearest, 1.0), nearest)

    monkeypatch.setattr(submaps, "merge_overlaps", close)
    bent = []
    for k, part in enumerate(parts):
        model = pycolmap.Reconstruction(part.model)
        model.camera(1).params = [300.0 + k, 300.0 + k, 240, 180]
        bent.append(replace(part, model=model))
    most = max(range(len(parts)), key=lambda k: parts[k].model.compute_num_observations())
    join_runs(ring.capture(), bent, near=4, loops=False)
    (whole,) = asked
    assert [list(camera.params) for camera in whole.cameras.values()] == [[300.0 + most, 300.0 + most, 240, 180]]


@pytest.mark.parametrize(
    ("least", "pairing", "in_parts"), [(48, "sequential", True), (49, "sequential", False), (48, "exhaustive", False)]
)
def test_what_is_long_is_mapped_in_parts(ring, tmp_path, monkeypatch, least, pairing, in_parts):
    import pycolmap

    ring = replace(ring[0], database=shutil.copyfile(ring[0].database, tmp_path / "database.db"))
    monkeypatch.setattr(submaps, "SIZES", replace(submaps.SIZES, least=least, shortest=18, longest=18, shared=1 / 3))
    asked, told, incremental = [], [], pycolmap.incremental_mapping

    def write_part(database, names, part):
        asked.append(list(names))
        # what a kill leaves is found by the next run
        assert part.parents[1] == tmp_path / "chunks"
        write_part_database(database, names, part)

    def in_one_go(*args, options, **more):
        asked.append(list(options.image_names))
        return incremental(*args, options=options, **more)

    monkeypatch.setattr("colmap_inertial.colmap.mapping.part_chunks.write_part_database", write_part)
    monkeypatch.setattr(pycolmap, "incremental_mapping", in_one_go)
    record = mapping.map_images(
        ring.database,
        tmp_path,
        tmp_path / "sparse",
        MappingOptions(overlap=3, pairing=pairing, refine_intrinsics=False),
        context=RunContext(scratch=tmp_path, num_threads=1, progress=lambda *step: told.append(step)),
        in_time=NAMES,
    )
    expected = runs(FRAMES, longest=18, shared=6)
    assert asked == ([NAMES[begin:end] for begin, end in expected] if in_parts else [NAMES])
    assert bool(record.seams) == in_parts and all(seam.joined for seam in record.seams)
    number = len(expected) if in_parts else 1
    assert record == mapping.MapRecord(mapper="incremental", models=1, parts=number, seams=record.seams)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert model.num_reg_images() == FRAMES and error_m(ring, model) < 0.008
    done = [count for _, count, total in told if total == FRAMES]
    assert done == sorted(done) and done[-1] == FRAMES and len(set(done)) > FRAMES / 2
    assert not [path for path in tmp_path.iterdir() if path.is_dir() and path.name != "sparse"]


def test_parts_may_have_cameras_that_others_lack(ring, tmp_path):
    """The second half of the lap has a camera of its own, and rigs are numbered otherwise than cameras."""
    import pycolmap

    ring, _ = ring
    path = tmp_path / "two_cameras.db"
    with pycolmap.Database.open(str(ring.database)) as old, pycolmap.Database.open(str(path)) as new:
        (camera,) = old.read_all_cameras()
        rig_of = {}
        for number in (1, 2):
            camera.camera_id = number
            new.write_camera(camera, use_camera_id=True)
        for number in (2, 1):
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
            rig_of[number] = new.write_rig(rig)
        for k, name in enumerate(NAMES, 1):
            camera_id = 1 if k <= FRAMES / 2 else 2
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
            frame = pycolmap.Frame(frame_id=k, rig_id=rig_of[camera_id])
            frame.add_data_id(pycolmap.data_t(sensor, k))
            new.write_frame(frame, use_frame_id=True)
            new.write_image(pycolmap.Image(name=name, camera_id=camera_id, image_id=k, frame_id=k), use_image_id=True)
            new.write_keypoints(k, old.read_keypoints(k))
        for pair in old.read_two_view_geometry_num_inliers()[0]:
            both = pycolmap.pair_id_to_image_pair(pair)
            geometry = old.read_two_view_geometry(*both)
            new.write_matches(*both, geometry.inlier_matches)
            new.write_two_view_geometry(*both, geometry)
    assert rig_of == {2: 1, 1: 2}
    parts = [(0, 20), (14, 34), (28, 48)]
    capture = replace(ring.capture(), database=path)
    made = submaps.map_runs(capture, tmp_path, tmp_path, parts, executor=Processes(number=2), registered=lambda _: None)
    (whole,), _ = join_runs(capture, made, near=4, loops=True)
    assert whole.num_reg_images() == FRAMES and error_m(ring, whole) < 0.008
    assert {whole.image(k).camera_id for k in range(1, FRAMES // 2 + 1)} == {1}
    assert {whole.image(k).camera_id for k in range(FRAMES // 2 + 1, FRAMES + 1)} == {2}


@pytest.mark.parametrize(
    ("turn_rad", "scale", "translation"),
    [((2.5, 0, 0), 0.3, (0, 40, 0)), ((0, 1.2, 0), 1.0, (3, 1, 2))],
    ids=["images go", "COLMAP's own check fails"],
)
def test_a_misplaced_part_does_not_fit_whatever_comes_of_the_adjustment(ring, turn_rad, scale, translation):
    ring, parts = ring
    placed = place_parts(4, list(submaps.find_ties(ring.capture(), parts, nearest=None).values()))
    lie = [placed.similarity(k) for k in range(4)]
    bad = similarity(scale, turn_rad, translation)
    whole, part_of = merge_parts(parts, placements([*lie[:3], bad * lie[3]]), NAMES)
    nearest = dict.fromkeys([(0, 1), (1, 2), (2, 3), (0, 3)])
    met = merge_overlaps(ring.capture(), whole, part_of=part_of, nearest=nearest)
    assert met.seams.keys() == nearest.keys() and all(set(one.images) <= set(NAMES) for one in met.seams.values())
    assert met.kept < 0.99 and not all(one.joined for one in met.seams.values())


def test_places_that_settle_are_given_and_those_that_do_not_are_refused():
    """A minimum is reached in one step; equations whose step never shrinks have none."""
    target = np.arange(1.0, PLACEMENT + 1)

    def drawn_to_target(state: Placements) -> Equations:
        equations = Equations(PLACEMENT)
        off = target * [0, 0, 0, 0, 1, 1, 1] - state.change
        equations.add(off, np.arange(PLACEMENT), -np.eye(PLACEMENT))
        return equations

    def fleeing(state: Placements) -> Equations:
        equations = Equations(PLACEMENT)
        equations.add(np.ones(PLACEMENT), np.arange(PLACEMENT), -np.eye(PLACEMENT))
        equations.squares = float(np.sum(state.change**2))
        return equations

    limits = Convergence(rounds=5, step=1e-9, squares=1e-12, squares_share=0.0)
    start = Placements.at_origin(np.ones(1))
    placed, cov, squares = minimise_placements(start, drawn_to_target, limits)
    assert np.allclose(placed.translation, [[5, 6, 7]]) and np.allclose(cov, np.eye(PLACEMENT)) and squares < 1e-20
    with pytest.raises(np.linalg.LinAlgError, match="do not converge"):
        minimise_placements(start, fleeing, limits)


@pytest.fixture(scope="module")
def map_parts_once():
    """``submaps.map_parts``, which maps a part with a seed once, as all callers split the ring alike."""
    import pycolmap

    mapped, map_parts = {}, submaps.map_parts

    def once(chunks, executor, registered):
        keys = [(chunk.name, chunk.work.options["random_seed"]) for chunk in chunks]
        new = [k for k, key in enumerate(keys) if key not in mapped]
        found = map_parts([chunks[k] for k in new], executor, registered)
        mapped.update(zip([keys[k] for k in new], found, strict=True))
        for key in keys:
            yield {number: pycolmap.Reconstruction(model) for number, model in mapped[key].items()}

    return once


@pytest.mark.parametrize(("bad", "tries"), [({0}, 2), ({0, 1}, 3), ({0, 1, 2}, 3)], ids=["once", "twice", "always"])
def test_a_part_with_large_residuals_is_mapped_again_with_other_seeds(
    ring, map_parts_once, tmp_path, monkeypatch, bad, tries
):
    ring, _ = ring
    capture, asked = ring.capture(), []

    def began_wrong(chunks, executor, registered):
        """The second part has residuals of 5 px less a tenth of its seed, with some seeds."""
        asked.append([(chunk.name, chunk.work.options["random_seed"]) for chunk in chunks])
        for chunk, models in zip(chunks, map_parts_once(chunks, executor, registered), strict=True):
            seed = chunk.work.options["random_seed"] - capture.pipeline.random_seed
            for model in models.values() if chunk.name == "mapping part 2" and seed in bad else ():
                for point in model.points3D.values():
                    point.error = 5.0 - 0.1 * seed
            yield models

    monkeypatch.setattr(submaps, "map_parts", began_wrong)
    parts = [(0, 20), (14, 34), (28, 48)]
    made = submaps.map_runs(capture, tmp_path, tmp_path, parts, executor=Processes(number=2), registered=lambda _: None)
    seed = capture.pipeline.random_seed
    assert asked[0] == [(f"mapping part {k}", seed) for k in (1, 2, 3)]
    assert asked[1:] == [[("mapping part 2", seed + k)] for k in range(1, tries)]
    assert [(part.begin, part.end) for part in made] == parts
    error_px = made[1].model.compute_mean_reprojection_error()
    assert error_px == pytest.approx(4.8) if len(bad) == 3 else error_px < 1


@pytest.mark.parametrize(
    ("found", "than", "better"),
    [
        ((20, 0.5), (20, 0.6), True),
        ((20, 0.6), (20, 0.5), False),
        ((18, 0.5), (20, 0.6), False),
        ((0, 0), (20, 2), False),
    ],
)
def test_models_of_a_part_are_better_with_smaller_residuals_of_about_as_many_images(found, than, better):
    class Model:
        def __init__(self, images, error_px):
            self.images, self.error_px = images, error_px

        def num_reg_images(self):
            return self.images

        def compute_mean_reprojection_error(self):
            return self.error_px

    of = [{0: Model(*either)} if either[0] else {} for either in (found, than)]
    assert submaps._is_better(*of) == bool(better)
