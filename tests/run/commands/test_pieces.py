"""Pieces of a run by themselves: identities of files, what is set aside, gaps, and what is refused before the work."""

import contextlib
import csv
import json
import re
import sqlite3
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from colmap_inertial.colmap.features import chunks as feature_chunks
from colmap_inertial.colmap.workers import warn_without_gpu
from colmap_inertial.core.errors import FormatError, InertialError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReconstructOptions, ValidateOptions
from colmap_inertial.core.types import FrameTiming
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.gate import GATE_LIMITS, RecordingVerdict
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.frame_sources import ImageFolder
from colmap_inertial.run.commands import frames as framing, reporting, validate as validation
from colmap_inertial.run.commands.validate import ValidationOutputs, validate_source
from colmap_inertial.run.preparation import blur_check, sampling
from colmap_inertial.run.preparation.frame_reading import GreyFrames
from colmap_inertial.run.preparation.plan import Treatments, plan_imaging
from colmap_inertial.run.stages.join import _beside, _spans
from colmap_inertial.run.stages.known_lengths import _find_place
from colmap_inertial.run.stages.readout import ReadoutStage
from colmap_inertial.run.stages.refine import _takes_turns
from colmap_inertial.run.steps import runner
from colmap_inertial.tools.batch import write_summary
from colmap_inertial.tools.batch.task import CaptureStatus, _verdict


def content_of(tmp_path, content: bytes):
    """What identifies a file but for its name, size and time."""
    path = tmp_path / f"{len(list(tmp_path.iterdir()))}"
    path.write_bytes(content)
    ((_, size, _, digest),) = fingerprint(path)
    assert size == len(content)
    return digest


def changed(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def test_every_byte_of_a_file_counts_but_how_often_a_database_was_opened(tmp_path):
    rng = np.random.default_rng(0)
    plain, database = rng.bytes(300), b"SQLite format 3\0" + rng.bytes(300)
    known, of_database = content_of(tmp_path, plain), content_of(tmp_path, database)
    assert known == content_of(tmp_path, plain) != of_database
    for at in (0, 20, 26, 91, 95, 99, 100, 299):
        assert content_of(tmp_path, changed(plain, at)) != known
    # SQLite's header: a counter of changes at 24, and at 92 the counter and the version that it is of
    counters = {*range(24, 28), *range(92, 100)}
    for at in (15, 16, 23, 24, 27, 28, 60, 91, 92, 99, 100, 200, 315):
        assert (content_of(tmp_path, changed(database, at)) == of_database) == (at in counters)


def test_of_a_large_file_pieces_over_its_whole_length_count(tmp_path):
    large = bytes(5 << 20)
    known = content_of(tmp_path, large)
    for at in (0, (5 << 20) // 2, (5 << 20) - 1):
        # more than the distance of two pieces
        other = bytearray(large)
        other[max(0, at - 70_000) : at + 1] = b"\1" * (at + 1 - max(0, at - 70_000))
        assert content_of(tmp_path, bytes(other)) != known


def test_gaps_lie_between_the_last_image_of_a_model_and_the_first_of_the_next():
    names = tuple(f"{k}" for k in range(9))
    timing = FrameTiming(names=names, t_s=np.arange(9.0) * 2, readout_s=0.0)

    def model(index, kept):
        images = {k: SimpleNamespace(name=name) for k, name in enumerate(kept)}
        return SimpleNamespace(
            timing=timing,
            colmap_index=index,
            reconstruction=SimpleNamespace(image=images.get, reg_image_ids=lambda: list(images)),
        )

    spans = _spans([model(0, "786"), model(1, ["2", "0", "1"]), model(2, "43"), model(3, ["other"])])
    assert spans == [(0, 4, 1), (6, 8, 2), (12, 16, 0)]
    why = Fact.stated("no IMU")
    assert [(gap.first, gap.second, gap.seconds, gap.joined, gap.reason) for gap in _beside(spans, {2: why})] == [
        (1, 2, 2, False, why),
        (2, 0, 4, False, why),
    ]
    assert [(gap.first, gap.second) for gap in _beside(spans, {0: why})] == [(2, 0)] and not _beside(spans, {})


def test_what_is_neither_a_point_nor_a_marker_is_refused(subtests):
    for text in ("nan,1,2", "1,inf,2", "1,2,x", "1,2", "-1", "one", "1234567890"):
        with subtests.test(text=text), pytest.raises(InertialError, match="--between"):
            _find_place(text, None)


def test_a_point_is_exact_and_a_marker_needs_markers():
    place, sigma = _find_place("1,-2.5,3e-1", None)
    assert place.tolist() == [1, -2.5, 0.3] and sigma == 0
    with pytest.raises(InertialError):
        _find_place("7", None)


def test_rectifying_by_name_needs_a_readout():
    recording = SimpleNamespace(
        capture=SimpleNamespace(path="capture"), timing=FrameTiming(names=("a",), t_s=np.zeros(1))
    )
    with pytest.raises(InertialError, match="needs readout_s"):
        plan_imaging(recording, None, None, None, Treatments(rolling_shutter="rectify"))


def test_a_model_is_scaled_by_its_control_distances_with_their_standard_deviation(tmp_path, monkeypatch):
    applied = []
    control = SimpleNamespace(metres_per_unit=0.5, ci95=(0.49, 0.51))
    found = SimpleNamespace(control=control)
    monkeypatch.setattr(validation, "validate_model", lambda *_: found)
    monkeypatch.setattr(validation, "only_model", lambda model: model)
    monkeypatch.setattr(validation, "refuse_links_around", lambda *_: None)
    monkeypatch.setattr(validation, "apply_similarity", lambda *given: applied.append(given))
    monkeypatch.setattr(ValidationOutputs, "check", lambda *_, **__: None)
    outputs = ValidationOutputs(apply=tmp_path / "metric")
    validate_source(tmp_path, tmp_path, "checkerboard:7x5:0.03", ValidateOptions(), outputs)
    ((_, target, similarity),) = applied
    assert target == outputs.apply and similarity.scale == 0.5
    # 2 per cent on each side are 1.96 standard deviations
    assert np.sqrt(similarity.cov[0, 0]) == pytest.approx(0.02 / 1.96, rel=1e-3)
    assert np.count_nonzero(similarity.cov) == 1 and similarity.rotation_xyzw.tolist() == [0, 0, 0, 1]
    found.control = None
    with pytest.raises(InertialError, match="too few corners"):
        validate_source(tmp_path, tmp_path, "checkerboard:7x5:0.03", ValidateOptions(), outputs)


@pytest.mark.parametrize(("deterministic", "threads"), [(True, 1), (False, -1)])
def test_what_is_to_come_out_the_same_is_adjusted_by_one_thread(monkeypatch, deterministic, threads):
    monkeypatch.setattr(ReadoutStage, "fields_for", classmethod(lambda cls, inputs: {"imu": None, "calibration": None}))
    monkeypatch.setattr(ReadoutStage, "refines_intrinsics", classmethod(lambda cls, inputs: False))
    inputs = SimpleNamespace(options=ReconstructOptions(deterministic=deterministic))
    assert ReadoutStage.for_run(inputs).num_threads == threads


def of_capture(**changed):
    """What a batch knows of a model: metric, without a target."""
    known = {"sparse_metric": "sparse/0", "reasons": [], "waiting": None, "scale_error_pct": None}
    return known | {"within_tolerance": None, "validation_error": None} | changed


def test_a_batch_judges_a_capture_by_the_worst_that_counts(subtests):
    for i, (models, code, said) in enumerate(
        (
            ([of_capture()], 0, None),
            ([of_capture(), of_capture(sparse_metric=None, reasons=["it hardly moved"])], 0, None),
            (
                [of_capture(sparse_metric=None, reasons=["a", "b"]), of_capture(sparse_metric=None, reasons=["c"])],
                3,
                "a; b; c",
            ),
            ([of_capture(waiting="no GPU"), of_capture(within_tolerance=False, scale_error_pct=4.0)], 2, "^no GPU$"),
            (
                [of_capture(within_tolerance=True), of_capture(within_tolerance=False, scale_error_pct=4.056)],
                1,
                r"\+4.06 %",
            ),
            ([of_capture(within_tolerance=True), of_capture(validation_error="not seen")], 0, None),
            ([of_capture(validation_error="not seen"), of_capture()], 0, None),
        )
    ):
        with subtests.test(i=i, code=code, said=said):
            found, error = _verdict(models)
            assert found == code
            assert error is None if said is None else re.search(said, error)


def test_a_summary_has_a_row_of_the_model_with_the_most_images(tmp_path):
    small = {"registered_images": 8, "verdict": "weak", "metres_per_unit": 2.0, "ci95": [1.0, 3.0]}
    large = {"registered_images": 40, "verdict": "trusted", "metres_per_unit": 0.5, "ci95": [0.4, 0.6]}
    captures = (
        CaptureStatus(name="hall", state="done", exit_code=0, models=(small, large, small), frames=50, seconds=12.34),
        CaptureStatus(name="=1+1", state="failed", exit_code=3, error="no"),
    )
    write_summary(SimpleNamespace(out=tmp_path, captures=captures))
    hall, other = csv.DictReader((tmp_path / "summary.csv").read_text().splitlines())
    expected = {"verdict": "trusted", "metres_per_unit": "0.5", "ci95_low": "0.4", "ci95_high": "0.6"}
    expected |= {"registered_images": "40", "frames": "50", "models": "3", "seconds": "12.3", "state": "done"}
    assert {name: hall[name] for name in expected} == expected
    # what a table would take for a formula is none
    assert other["name"] != "=1+1" and other["name"].endswith("=1+1") and other["registered_images"] == ""
    counts = json.loads((tmp_path / "summary.json").read_text())
    assert (counts["done"], counts["failed"], counts["interrupted"]) == (1, 1, 0)


def test_a_worker_s_database_is_looked_through(tmp_path):
    work, path = object.__new__(feature_chunks._DatabaseWork), tmp_path / feature_chunks._MADE
    with contextlib.closing(sqlite3.connect(path)) as made:
        made.execute("CREATE TABLE keypoints (number INTEGER PRIMARY KEY, data BLOB)")
        made.execute("INSERT INTO keypoints VALUES (1, NULL)")
        made.commit()
        work.check(tmp_path)
        # a table that holds what it may not
        made.execute("PRAGMA writable_schema = 1")
        made.execute("UPDATE sqlite_master SET sql = replace(sql, 'BLOB', 'BLOB NOT NULL')")
        made.commit()
    with pytest.raises(FormatError, match="damaged"):
        work.check(tmp_path)
    path.write_bytes(b"no database at all, but long enough to be one" * 50)
    with pytest.raises(FormatError):
        work.check(tmp_path)


def test_a_report_knows_rates_times_and_how_far_keypoints_moved(tmp_path, monkeypatch):
    monkeypatch.setattr(GreyFrames, "guess_camera", lambda _: SimpleNamespace(width=640, height=480))
    names = ("a", "b", "c", "d")
    timing = FrameTiming(names=names, t_s=np.array([5.0, 5.5, 6.25, 7.0]), exposure_s=np.full(4, 0.004), readout_s=0.02)
    gyro_s, accel_s = 4 + np.arange(1000) / 200, 4 + np.arange(500) / 100
    imu = SimpleNamespace(device="phone", gyro_t_s=gyro_s, accel_t_s=accel_s)
    recording = SimpleNamespace(imu=imu, timing=timing, capture=None)
    shift_px = {"a": 1.0, "b": -3.0, "c": 2.0}

    def stage(points):
        if points.name == "c":
            raise ValueError("far outside")
        # growing from left to right
        moved = points.xy_px + shift_px[points.name] * points.xy_px[:, :1] / 640 * np.array([0.6, 0.8])
        return replace(points, xy_px=moved, rectified=True)

    session = SimpleNamespace(workspace=SimpleNamespace(root=tmp_path, report_data=tmp_path / "report_data"))
    monkeypatch.setattr(reporting, "recording_file", lambda root: root / "recording.json")
    reporting.write_recording(session, recording, (stage,), {"a", "b", "c"})
    record = json.loads((tmp_path / "recording.json").read_text())
    assert record["imu"] == {
        "device": "phone",
        "gyro_hz": pytest.approx(200),
        "accel_hz": pytest.approx(100),
        "duration_s": pytest.approx(999 / 200),
    }
    frames = record["frames"]
    assert frames["count"] == 4 and frames["duration_s"] == 2 and frames["interval_s"] == 0.75
    assert frames["t_s"] == [0, 0.5, 1.25, 2] and frames["exposure_s"] == [0.004] * 4 and frames["readout_s"] == 0.02
    shutter = record["rolling_shutter"]
    assert shutter["t_s"] == [0, 0.5] and shutter["worst"]["name"] == "b"
    # in the middle of the last of nine columns, and of the fifth
    assert shutter["largest_px"] == pytest.approx([17 / 18, 3 * 17 / 18], abs=1e-3)
    assert shutter["median_px"] == pytest.approx([0.5, 1.5], abs=1e-3)
    at, moved = (np.array(shutter["worst"][name]) for name in ("at_px", "shift_px"))
    assert len(at) == 81 and moved == pytest.approx(-3 * at[:, :1] / 640 * np.array([0.6, 0.8]), abs=2e-3)
    reporting.write_recording(session, recording, (stage,))
    assert json.loads((tmp_path / "recording.json").read_text())["rolling_shutter"] is None


def test_what_was_lost_since_a_run_is_said_with_the_error(tmp_path, monkeypatch):
    space = SimpleNamespace(root=tmp_path / "out", stamps=tmp_path)
    lost = []
    monkeypatch.setattr(runner, "find_loss", lambda *_: lost[0] if lost else None)
    with runner.explaining_losses(space):
        pass
    with pytest.raises(FormatError, match=r"a.bin: is damaged$"), runner.explaining_losses(space):
        raise FormatError("a.bin", Fact.stated("is damaged"))
    lost.append("sparse/0/cameras.bin")
    with (
        pytest.raises(FormatError, match=r"out: a.bin: is damaged; sparse/0/cameras.bin was damaged or removed since"),
        runner.explaining_losses(space),
    ):
        raise FormatError("a.bin", Fact.stated("is damaged"))


def cluster_of(offers, *, old):
    """A scheduler that tells the workers' resources; an old one those of the first only, and takes no arguments."""

    def scheduler_info(**asked):
        if asked and old:
            raise TypeError(asked)
        return {"workers": dict(enumerate(offers if asked or old else offers[:1]))}

    return SimpleNamespace(scheduler_info=scheduler_info)


def test_a_cluster_without_a_gpu_is_warned_of(subtests, caplog):
    for offers, warned in (
        ([{}, {"resources": {"GPU": 1}}], False),
        ([{"resources": {"GPU": 2}}], False),
        ([{"resources": {}}, {}], True),
        ([], True),
    ):
        for old in (False, True):
            with subtests.test(offers=offers, old=old):
                caplog.clear()
                warn_without_gpu(cluster_of(offers, old=old), "depth maps")
                assert ("depth maps wait for one" in caplog.text) == warned


def test_a_camera_that_nobody_states_is_guessed_as_colmap_does(tmp_path):
    """A focal length of 1.2 times the longer side, and the middle of the picture."""
    assert cv2.imwrite(str(tmp_path / "0.png"), np.zeros((480, 640, 3), np.uint8))
    capture = SimpleNamespace(camera=None, frames=ImageFolder(folder=tmp_path))
    timing = FrameTiming(names=("0.png",), t_s=np.zeros(1))
    guessed = GreyFrames(capture, timing).guess_camera()
    assert (guessed.model, guessed.width, guessed.height) == ("SIMPLE_PINHOLE", 640, 480)
    assert guessed.params == pytest.approx((768, 320, 240))
    known = object()
    assert GreyFrames(SimpleNamespace(camera=known), timing).guess_camera() is known


def test_samples_of_a_recording_are_as_far_apart_as_asked_from_where_they_are_to_begin():
    def timing(t_s):
        return FrameTiming(names=tuple(f"{k}" for k in range(len(t_s))), t_s=np.asarray(t_s, dtype=float))

    tenths = timing(0.125 * np.arange(101))
    assert sampling.sample_spaced(tenths, 0.25) == list(range(0, 101, 2))
    assert sampling.sample_spaced(tenths, 0.26) == list(range(0, 101, 3))
    assert sampling.sample_spaced(timing([0, 0.1, 0.9, 1.0, 1.1, 3.0]), 1.0) == [0, 3, 5]
    # the middle eleven of 51
    assert sampling.sample_middle(tenths, 0.25, 11) == list(range(40, 61, 2))
    assert sampling.sample_middle(tenths, 0.25, 60) == list(range(0, 101, 2))
    # a quarter of a frame less than asked will do; not in the middle, but as late as the limit
    limit_s = sampling._LIMITS.begin_s
    found = sampling.sample_beginning(tenths, 0.28, 11)
    assert np.diff(found).tolist() == [2] * 10
    assert found[0] == min(40, 2 * int(np.ceil(limit_s / 0.25)))
    long = timing(0.25 * np.arange(2001))
    assert long.t_s[sampling.sample_beginning(long, 0.5, 10)[0]] == pytest.approx(0.5 * np.ceil(limit_s / 0.5))
    assert sampling.sample_beginning(timing([2.0]), 0.5, 10) == [0]


def test_the_part_that_is_shown_of_a_picture_is_the_one_with_the_most_texture():
    limits, rng = framing._LIMITS, np.random.default_rng(5)
    height, width = 2 * limits.height, 3 * limits.width
    picture = np.full((height, width, 3), 120, np.uint8)
    place = slice(limits.height - 40, 2 * limits.height - 60), slice(limits.width + 30, 2 * limits.width + 10)
    picture[place] = rng.integers(60, 200, (limits.height - 20, limits.width - 20, 3))
    top, left, *size = framing._busiest(picture)
    assert size == [limits.height, limits.width]
    assert place[0].stop - limits.height - 20 <= top <= place[0].start + 20
    assert place[1].stop - limits.width - 20 <= left <= place[1].start + 20
    assert framing._busiest(picture[: limits.height - 7, : limits.width - 9]) == (
        0,
        0,
        limits.height - 7,
        limits.width - 9,
    )


def test_segments_are_drawn_as_long_as_the_blur_where_it_is():
    """Blur of 20 px on the right half of a picture, of which a part is drawn that begins elsewhere."""
    rows, columns = BlurField.nodes(400, 300, 10)
    vectors = np.zeros((rows, columns, 2))
    vectors[:, columns // 2 + 1 :] = [0.0, 20.0]
    field = BlurField(width=400, height=300, step_px=10, vector_px=vectors)
    every = framing._LIMITS.arrows_px
    part = np.zeros((2 * every, 300, 3), np.uint8)
    framing._draw(part, field, 50, 100)
    drawn = part[..., 0] > 128
    assert set(map(tuple, part[drawn & (part[..., 0] == 255)].tolist())) <= {(255, 60, 0)}
    for y in (every // 2, every + every // 2):
        for x in range(every // 2, 300, every):
            length = int(drawn[y - every // 2 : y + every // 2, x].sum())
            if abs(100 + x - 200) > 10:
                assert (18 <= length <= 24) == (100 + x > 200) and (length < 5) == (100 + x < 200)


def test_a_file_that_is_not_there_has_no_identity(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        fingerprint(tmp_path / "absent")
    (tmp_path / "b").write_bytes(b"1")
    (tmp_path / "a").write_bytes(b"23")
    assert [(row[0].rpartition("/")[2], row[1]) for row in fingerprint(tmp_path)] == [("a", 2), ("b", 1)]


def taken_by(cameras, *, focal_px=(), folders=()):
    """A model of images in order of time, each taken by the camera of this number."""
    names = tuple(f"{folder}{k:02}.jpg" for k, folder in enumerate(folders or [""] * len(cameras)))
    images = {
        # numbered against the order of time
        len(names) - k: SimpleNamespace(name=name, camera_id=camera)
        for k, (name, camera) in enumerate(zip(names, cameras, strict=True))
    }
    focal = dict(zip(cameras, focal_px or [500.0] * len(cameras), strict=True))

    def camera(number):
        return SimpleNamespace(camera_id=number, width=640, height=480, mean_focal_length=lambda: float(focal[number]))

    model = SimpleNamespace(image=images.get, reg_image_ids=lambda: sorted(images), camera=camera)
    timing = FrameTiming(names=names, t_s=np.arange(float(len(names))), readout_s=0.0)
    return SimpleNamespace(reconstruction=model, timing=timing)


def test_cameras_take_turns_where_they_come_back_often(subtests):
    for i, (model, alternate) in enumerate(
        (
            (taken_by([1] * 20), False),
            (taken_by([1] * 10 + [2] * 10), False),
            (taken_by([1, 2] * 10), True),
            # there and back is no turn: two returns in twenty are a tenth
            (taken_by([1] * 6 + [2] * 6 + [1] * 8), False),
            (taken_by([1] * 5 + [2] * 5 + [1] * 5 + [2] * 5), False),
            (taken_by([1] * 5 + [2] * 5 + [1] * 4 + [2] * 3 + [1] * 3), True),
            # each image with a camera of its own: two folders, or two focal lengths more than a tenth apart
            (taken_by(range(20)), False),
            (taken_by(range(20), folders=["left/", "right/"] * 10), True),
            (taken_by(range(20), focal_px=[500, 560] * 10), True),
            (taken_by(range(20), focal_px=[500, 540] * 10), False),
            (taken_by(range(20), focal_px=np.linspace(500, 900, 20).tolist()), False),
        )
    ):
        with subtests.test(i=i, alternate=alternate):
            assert _takes_turns(model) == alternate


def test_frames_speak_for_themselves_where_too_few_confirm_the_gyroscope(subtests):
    for shown, telling, skies, trusted in (
        (0, 0, 0, True),
        (19, 20, 0, True),
        (18, 20, 0, None),
        (18, 20, 10, None),
        (17, 20, 11, True),
        (16, 20, 11, None),
    ):
        with subtests.test(shown=shown, telling=telling, skies=skies, trusted=trusted):
            enough = SimpleNamespace(enough=True)
            looked = [
                SimpleNamespace(
                    evidence=enough, blur_px=GATE_LIMITS.must_show_px, shows=k < shown, is_mostly_sky=k < skies
                )
                for k in range(telling)
            ]
            # of no account: too little to see, and too little blur
            looked += [
                SimpleNamespace(evidence=SimpleNamespace(enough=tells), blur_px=px, shows=False, is_mostly_sky=False)
                for tells, px in ((False, 99.0), (True, 0.9 * GATE_LIMITS.must_show_px))
            ] * 20
            verdict = RecordingVerdict(
                trusted=True, support=5.0, extent_factor=1.0, frames=9, reason=Fact.stated("as it was")
            )
            found = blur_check.judge_each_frame(verdict, looked)
            assert found.trusted is trusted
            assert (
                str(found.reason) == "as it was"
                if trusted
                else f"{shown} of {telling} examined frames" in str(found.reason)
            )
            doubted = replace(verdict, trusted=False)
            assert blur_check.judge_each_frame(doubted, looked) is doubted
