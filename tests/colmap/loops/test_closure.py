"""Ends of a model that met: joined where they show the same, left alone where they do not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.colmap.loops import closure as loop_closure
from colmap_inertial.colmap.loops.closure import LoopClosure, MappedCapture, close_gaps
from colmap_inertial.io.files import read_record, write_record

#: A camera turns once around in the middle of a round room, looking outwards.
FRAMES, RING_M, ROOM_M = 48, 3.0, 5.0
FOCAL_PX, SIZE_PX = 300.0, (480, 360)
#: A lap is mapped as so much more than one: the camera is taken for so much wider than it was, so that no adjustment of
#: the torn model brings its ends together.
DRIFT = 1.03
WIDER = 1.04
NAMES = [f"{k:03d}.jpg" for k in range(FRAMES)]


@dataclass
class Ring:
    """A model of a lap around a room, its ends off by what has drifted, and the matches it was made from."""

    database: Path
    model: object
    options: object

    def capture(self, names=None) -> MappedCapture:
        return MappedCapture(database=self.database, pipeline=self.options, names=NAMES if names is None else names)

    def error_m(self) -> float:
        """Of centres, after a similarity, rms."""
        found = np.array([self.model.image(k + 1).projection_center() for k in range(FRAMES)])
        true = centres_m(1.0)
        a, b = found - found.mean(axis=0), true - true.mean(axis=0)
        u, s, vt = np.linalg.svd(b.T @ a)
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        scale = np.sum(s * np.diag(sign)) / np.sum(a**2)
        return float(np.sqrt(np.mean(np.sum((scale * a @ (u @ sign @ vt).T - b) ** 2, axis=1))))


def angles(stretched: float) -> np.ndarray:
    return 2 * np.pi / FRAMES * stretched * np.arange(FRAMES)


def centres_m(stretched: float) -> np.ndarray:
    angle = angles(stretched)
    return RING_M * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def cam_from_world(angle: float) -> np.ndarray:
    """Rows: right, down, out of the ring."""
    out = np.array([np.cos(angle), np.sin(angle), 0])
    return np.array([[out[1], -out[0], 0], [0, 0, -1], out])


def make(
    folder: Path,
    *,
    drift: float = DRIFT,
    wider: float = WIDER,
    shuffled: bool = False,
    true_focal_px: float = FOCAL_PX,
) -> Ring:
    """``shuffled``: matches between both ends join what is not the same."""
    import pycolmap

    rng = np.random.default_rng(5)
    angle, height = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(-1, 1, 1500)
    points = np.stack([ROOM_M * np.cos(angle), ROOM_M * np.sin(angle), height], axis=1)
    seen, xy = [], []
    for k, at in enumerate(angles(1.0)):
        in_cam = (points - centres_m(1.0)[k]) @ cam_from_world(at).T
        px = true_focal_px * in_cam[:, :2] / in_cam[:, 2:] + np.array(SIZE_PX) / 2
        shown = np.flatnonzero((in_cam[:, 2] > 0.5) & (px > 0).all(axis=1) & (px < SIZE_PX).all(axis=1))
        seen.append(shown)
        xy.append(px[shown] + 0.3 * rng.standard_normal((len(shown), 2)))
    focal_px = true_focal_px / wider
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=480, height=360, params=[focal_px, focal_px, 240, 180])
    camera.has_prior_focal_length = True
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for k, at in enumerate(angles(drift)):
        turn = cam_from_world(at)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ centres_m(drift)[k])
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=NAMES[k], keypoints=xy[k], camera_id=1, image_id=k + 1), pose
        )
    _add_points(model, seen, angle, height, drift)
    path = folder / "database.db"
    with pycolmap.Database.open(str(path)) as opened:
        opened.write_camera(camera, use_camera_id=True)
        opened.write_rig(model.rig(1), use_rig_id=True)
        for k in range(FRAMES):
            image = pycolmap.Image(name=NAMES[k], camera_id=1, image_id=k + 1, frame_id=k + 1)
            opened.write_frame(model.frame(k + 1), use_frame_id=True)
            opened.write_image(image, use_image_id=True)
            opened.write_keypoints(k + 1, np.column_stack([xy[k], np.ones((len(xy[k]), 4))]).astype(np.float32))
        for i in range(FRAMES):
            for j in (i + 1, i + 2):
                _, mine, other = np.intersect1d(seen[i], seen[j % FRAMES], return_indices=True)
                if shuffled and j >= FRAMES:
                    other = rng.permutation(other)
                first, second = sorted([(i + 1, mine), (j % FRAMES + 1, other)], key=lambda one: one[0])
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = np.stack([first[1], second[1]], axis=1).astype(np.uint32)
                opened.write_matches(first[0], second[0], geometry.inlier_matches)
                opened.write_two_view_geometry(first[0], second[0], geometry)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    return Ring(database=path, model=model, options=options)


def _add_points(model, seen: list[np.ndarray], angle: np.ndarray, height: np.ndarray, drift: float) -> None:
    """Where the drifted cameras see them; what the first and the last see, twice."""
    import pycolmap

    for point in range(len(angle)):
        views = [(k, int(np.searchsorted(seen[k], point))) for k in range(FRAMES) if point in seen[k]]
        late = [view for view in views if view[0] >= FRAMES // 2]
        early = [view for view in views if view[0] < FRAMES // 2]
        apart = bool(early) and bool(late) and late[-1][0] - early[0][0] > FRAMES // 2 and drift > 1
        for group in (early, late) if apart else (views,):
            if len(group) < 2:
                continue
            # a lap further on where the last ones see it from
            turns = angle[point] + (2 * np.pi if group is late and angle[point] < np.pi else 0)
            turns -= 2 * np.pi if group is early and apart and angle[point] > np.pi else 0
            at = np.array([ROOM_M * np.cos(drift * turns), ROOM_M * np.sin(drift * turns), height[point]])
            elements = [pycolmap.TrackElement(k + 1, feature) for k, feature in group]
            model.add_point3D(at, pycolmap.Track(elements=elements), np.zeros(3, dtype=np.uint8))


def test_ends_that_met_are_joined_and_what_drifted_on_the_way_goes(tmp_path):
    ring = make(tmp_path)
    before = ring.error_m()
    assert before > 0.05
    met = close_gaps(ring.capture(), ring.model, nearest=None)
    # frames 0 and 1 are matched with the last two
    assert met.joined and met.pairs == 3 and met.agree > 0.9
    assert met.images[0] in NAMES[:2] and met.images[1] in NAMES[-2:]
    assert ring.error_m() < before / 10
    first, last = ({p.point3D_id for p in ring.model.image(k).get_observation_points2D()} for k in (1, FRAMES))
    assert len(first & last) > 30


def test_a_model_that_is_whole_stays_as_it_is(tmp_path):
    ring = make(tmp_path, drift=1.0)
    before = [ring.model.image(k + 1).projection_center() for k in range(FRAMES)]
    assert close_gaps(ring.capture(), ring.model, nearest=None) is None
    np.testing.assert_array_equal([ring.model.image(k + 1).projection_center() for k in range(FRAMES)], before)


def test_ends_whose_matches_join_what_is_not_the_same_are_not_joined(tmp_path):
    ring = make(tmp_path, shuffled=True)
    met = close_gaps(ring.capture(), ring.model, nearest=None)
    assert not met.joined and met.agree < 0.5


@pytest.mark.parametrize("names", [NAMES, []], ids=["far apart in time", "not in the recording"])
def test_ends_are_not_joined_by_pairs_of_which_nobody_knows_whether_they_join_copies(tmp_path, names):
    ring = make(tmp_path)
    before = ring.error_m()
    assert close_gaps(ring.capture(names), ring.model, nearest=8) is None
    assert ring.error_m() == before


@pytest.mark.parametrize(("given", "joins"), [(True, True), (True, False), (False, True)])
def test_the_mapper_s_model_is_the_joined_one_where_the_order_in_time_is_known(tmp_path, monkeypatch, given, joins):
    import pycolmap

    from colmap_inertial.colmap.context import RunContext
    from colmap_inertial.colmap.mapping import mapper as mapping
    from colmap_inertial.core.options import MappingOptions

    ring = make(tmp_path)
    asked = []

    def made(database, images, out, **_):
        (Path(out) / "0").mkdir(parents=True)
        ring.model.write_binary(str(Path(out) / "0"))
        return {0: ring.model}

    def close(capture, model, *, nearest):
        asked.append((list(capture.names), nearest))
        model.deregister_frame(1)  # a mark
        return LoopClosure(pairs=4, images=(NAMES[0], NAMES[-1]), agree=0.7, joined=joins)

    monkeypatch.setattr(pycolmap, "incremental_mapping", made)
    monkeypatch.setattr(mapping, "close_gaps", close)
    options = MappingOptions(overlap=3, refine_intrinsics=False)
    record = mapping.map_images(
        ring.database,
        tmp_path,
        tmp_path / "sparse",
        options,
        context=RunContext(scratch=tmp_path),
        in_time=NAMES if given else (),
        judged=False,
    )
    assert asked == ([(NAMES, 2 * options.overlap)] if given else [])
    written = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert written.num_reg_images() == FRAMES - (given and joins)
    said = mapping.ModelEnds(model=0, pairs=4, images=(NAMES[0], NAMES[-1]), agree=0.7, joined=joins)
    assert record == mapping.MapRecord(mapper="incremental", models=1, ends=(said,) if given else ())
    write_record(tmp_path / "record.json", record)
    assert read_record(tmp_path / "record.json", mapping.MapRecord) == record


@pytest.mark.parametrize(
    ("pairing", "judged", "nearest"), [("sequential", True, None), ("sequential", False, 6), ("exhaustive", True, 6)]
)
def test_pairs_far_apart_in_time_are_believed_where_somebody_looked(tmp_path, monkeypatch, pairing, judged, nearest):
    import pycolmap

    from colmap_inertial.colmap.context import RunContext
    from colmap_inertial.colmap.mapping import mapper as mapping
    from colmap_inertial.core.options import MappingOptions

    ring = make(tmp_path)
    asked = []
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, **__: {0: ring.model})
    monkeypatch.setattr(mapping, "close_gaps", lambda *_, nearest: asked.append(nearest))
    mapping.map_images(
        ring.database,
        tmp_path,
        tmp_path / "sparse",
        MappingOptions(overlap=3, pairing=pairing, refine_intrinsics=False),
        context=RunContext(scratch=tmp_path),
        in_time=NAMES,
        judged=judged,
    )
    assert asked == [nearest]


def test_a_large_model_is_solved_directly_unless_all_images_see_the_same(subtests, tmp_path_factory):
    for all_see_it, directly in ((False, True), (True, False)):
        with subtests.test(all_see_it=all_see_it, directly=directly), pytest.MonkeyPatch.context() as monkeypatch:
            tmp_path = tmp_path_factory.mktemp("given")
            import pycolmap

            ring = make(tmp_path)
            if all_see_it:
                elements = [pycolmap.TrackElement(k + 1, 0) for k in range(FRAMES)]
                for element in elements:
                    if ring.model.image(element.image_id).point2D(0).has_point3D():
                        ring.model.delete_observation(element.image_id, 0)
                ring.model.add_point3D(np.zeros(3), pycolmap.Track(elements), np.zeros(3, dtype=np.uint8))
            assert (loop_closure._work(ring.model) == loop_closure._work_of(FRAMES)) == all_see_it
            as_it_is = pycolmap.BundleAdjustmentOptions().ceres.max_num_images_direct_sparse_cpu_solver
            adjustment = loop_closure._adjustment(ring.options, ring.model, of_parts=False)
            # what is small is as COLMAP has it, and a model of parts ends early
            first_region = adjustment.ceres.solver_options.initial_trust_region_radius
            assert adjustment.ceres.solver_options.function_tolerance == 0
            of_parts = loop_closure._adjustment(ring.options, ring.model, of_parts=True)
            assert of_parts.ceres.solver_options.function_tolerance == loop_closure.CLOSURE.least_gain
            assert of_parts.ceres.solver_options.initial_trust_region_radius > 1e5 * first_region
            assert adjustment.ceres.max_num_images_direct_sparse_cpu_solver == as_it_is
            monkeypatch.setattr(loop_closure, "LONGEST", FRAMES - 8)
            adjustment = loop_closure._adjustment(ring.options, ring.model, of_parts=False)
            assert adjustment.ceres.max_num_images_direct_sparse_cpu_solver == (FRAMES if directly else as_it_is)
            assert adjustment.ceres.solver_options.function_tolerance > 0
