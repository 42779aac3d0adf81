"""Captures of short and long exposures, and the frames made of them."""

import errno
import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import (
    FormatError,
    InertialError,
    MissingExtraError,
    NotObservableError,
    OutputError,
    OutputExistsError,
    TimingError,
)
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ExposureOptions, ReconstructOptions
from colmap_inertial.core.progress import silent
from colmap_inertial.imaging.exposure_pairs import replace_departures
from colmap_inertial.imaging.restoration import shipped
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_timing, read_frames
from colmap_inertial.run.commands import images_alone, reconstruct as driver
from colmap_inertial.run.commands.images_alone import deblur_capture, fuse_exposure_capture
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.preparation import plan
from colmap_inertial.run.stages import frame_folder
from colmap_inertial.run.stages.exposures import ExposureStage
from colmap_inertial.run.stages.inputs import Fuser
from colmap_inertial.run.steps.workspace import Workspace
from tests.helpers import small_networks as small
from tests.helpers.desk_scene import contents
from tests.helpers.exposure_scenes import GAIN, LONG_S, SHORT_S, psnr_db, write_pair_capture
from tests.helpers.json_schemas import find_violations

DOCS = Path(__file__).parents[3] / "docs"


def average(short, long, blur):
    """In place of the network: brightness of both, sharpness of neither."""
    assert short.dtype == long.dtype == np.float32 and short.shape == long.shape
    assert blur is None or (blur.height, blur.width) == short.shape[:2]
    return 0.5 * (short + long)


AVERAGE = Fuser(fuse=average, identity="average")


def write_pairs(folder, pairs):
    """Pairs with as much of the IMU's recording as they need."""
    scenes = write_pair_capture(folder, pairs=pairs)
    header, *rows = (folder / "imu.csv").read_text().splitlines()
    begin_s, end_s = scenes[0].short.t_s - 1, scenes[-1].long.t_s + 1
    near = [row for row in rows if begin_s < float(row.split(",", 1)[0]) < end_s]
    (folder / "imu.csv").write_text("\n".join([header, *near]) + "\n")
    return scenes


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs") / "capture"
    return folder, write_pairs(folder, 3)


@pytest.fixture(scope="module")
def two_pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two_pairs") / "capture"
    write_pairs(folder, 2)
    return folder


@pytest.fixture
def capture(two_pairs, tmp_path):
    return shutil.copytree(two_pairs, tmp_path / "capture")


def changed(folder, *pairs):
    path = folder / "capture.toml"
    text = path.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    return path


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


# --- capture.toml -----------------------------------------------------------------------------------------------------


def test_the_table_says_where_long_exposures_are_and_when(written):
    folder, scenes = written
    loaded = load_capture(folder)
    names = ["000.png", "001.png", "002.png"]
    assert loaded.exposures.files(names) == [folder / "long" / name for name in names]
    timing = read_frame_timing(loaded)
    long = loaded.exposures.timing(timing)
    assert long.exposure_s == pytest.approx([LONG_S] * 3)
    assert long.t_s - timing.t_s == pytest.approx([s.long.t_s - s.short.t_s for s in scenes])
    gain = loaded.exposures.stated_gain(
        folder / "short" / "000.png", folder / "long" / "000.png", short_exposure_s=SHORT_S, long_exposure_s=LONG_S
    )
    assert gain == pytest.approx(GAIN)


def test_constants_stand_in_for_a_table_of_times(capture):
    changed(capture, ('times = "long.csv"', "long_delay_s = 0.02\nlong_exposure_s = 0.08"))
    loaded = load_capture(capture)
    timing = read_frame_timing(loaded)
    long = loaded.exposures.timing(timing)
    assert long.t_s == pytest.approx(timing.t_s + 0.02) and long.exposure_s == pytest.approx([0.08, 0.08])
    changed(capture, ("long_exposure_s = 0.08\n", ""))
    assert load_capture(capture).exposures.timing(timing) is None


def test_an_exposure_time_that_the_table_lacks_is_filled_in(capture):
    rows = (capture / "long.csv").read_text().splitlines()
    (capture / "long.csv").write_text("\n".join(row.rpartition(",")[0] for row in rows) + "\n")
    loaded = load_capture(capture)
    assert loaded.exposures.timing(read_frame_timing(loaded)) is None
    changed(capture, ('times = "long.csv"', 'times = "long.csv"\nlong_exposure_s = 0.05'))
    loaded = load_capture(capture)
    assert loaded.exposures.timing(read_frame_timing(loaded)).exposure_s == pytest.approx([0.05, 0.05])


def test_partners_have_the_same_stem_or_are_renamed(tmp_path):
    write_pair_capture(tmp_path / "a", pairs=1, suffix=".jpg")
    assert load_capture(tmp_path / "a").exposures.path("000.png") == tmp_path / "a" / "long" / "000.jpg"
    write_pair_capture(tmp_path / "b", pairs=1)
    (tmp_path / "b" / "short" / "000.png").rename(tmp_path / "b" / "x_s.png")
    (tmp_path / "b" / "long" / "000.png").rename(tmp_path / "b" / "x_l.png")
    for name, new in (("frames", "x_s"), ("long", "x_l")):
        table = tmp_path / "b" / f"{name}.csv"
        table.write_text(table.read_text().replace("000.png", f"{new}.png"))
    changed(
        tmp_path / "b",
        ('folder = "short"', 'folder = "."\npattern = "*_s.png"'),
        ('folder = "long"', 'rename = ["_s.", "_l."]'),
    )
    loaded = load_capture(tmp_path / "b")
    assert loaded.exposures.path("x_s.png") == tmp_path / "b" / "x_l.png"
    assert loaded.exposures.timing(read_frame_timing(loaded)) is not None
    changed(tmp_path / "b", ("*_s.png", "*.png"))
    with pytest.raises(FormatError, match=r"let pattern under .images. match the short ones only"):
        fuse_exposure_capture(tmp_path / "b", tmp_path / "out", fuser=AVERAGE, progress=silent)


def test_what_is_wrong_with_the_exposures_is_said(subtests, two_pairs, tmp_path):
    wrong = (
        ('folder = "long"', "", "the same images as .images."),
        ('folder = "long"', 'folder = "short"', "the same images as .images."),
        ('folder = "long"', 'folder = "long"\nrename = "x"', "must be two strings"),
        ('folder = "long"', 'folder = "long"\nlong_delay_s = 0.1', "together with times"),
        ("short_iso = 1600", "short_iso = 0", "must be above 0"),
        ("short_iso = 1600", "long_exposure_s = 11", "must be from 0 to 10"),
        ("short_iso = 1600", "long_delay_s = 11", "must be from -10 to 10"),
        ("short_iso = 1600", "shrot_iso = 1600", 'did you mean "short_iso"'),
        ('[images]\nfolder = "short"\ntimes = "frames.csv"', 'video = "a.mp4"', r"needs \[images\]"),
    )
    for i, (old, new, reason) in enumerate(wrong):
        with subtests.test(new=new, reason=reason):
            capture = shutil.copytree(two_pairs, tmp_path / str(i))
            changed(capture, (old, new))
            with pytest.raises(FormatError, match=reason):
                load_capture(capture)


def test_a_camera_has_apertures_or_exposures(tmp_path):
    from tests.run.stages.test_apertures import write_plane_capture

    write_plane_capture(tmp_path)
    path = tmp_path / "capture.toml"
    path.write_text(path.read_text() + '[exposures]\nfolder = "long"\n')
    with pytest.raises(FormatError, match="not both"):
        load_capture(path)


def test_times_of_another_clock_or_of_other_pictures_are_named(capture):
    loaded = load_capture(capture)
    timing = read_frame_timing(loaded)
    rows = (capture / "long.csv").read_text().splitlines()
    (capture / "long.csv").write_text("\n".join(rows[:2]) + "\n")
    with pytest.raises(TimingError, match=r"no row for 001.png, the long exposure of 001.png"):
        loaded.exposures.timing(timing)
    (capture / "long.csv").write_text("\n".join([*rows[:2], f"001.png,1700000000.0,{LONG_S}"]) + "\n")
    with pytest.raises(TimingError, match=r"001.png starts 1.7e.09 s after the short one"):
        loaded.exposures.timing(timing)


def test_exif_states_exposure_and_sensitivity(capture, tmp_path):
    def jpeg(path, exposure, iso):
        directory = struct.pack("<HHHIII", 1, 0x8769, 4, 1, 26, 0)
        entries = struct.pack("<HHIIHHIHHI", 0x829A, 5, 1, 56, 0x8827, 3, 1, iso, 0, 0)
        body = b"Exif\0\0II*\0" + struct.pack("<I", 8) + directory + struct.pack("<H", 2) + entries
        body += struct.pack("<II", *exposure)
        data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
        path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
        return path

    short = jpeg(tmp_path / "short.jpg", (1, 200), 1600)
    long = jpeg(tmp_path / "long.jpg", (1, 10), 100)
    changed(capture, ("short_iso = 1600\n", ""))
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text("\n".join(line for line in text.splitlines() if "long_iso" not in line))
    exposures = load_capture(capture).exposures
    assert exposures.stated_gain(short, long) == pytest.approx(20 / 16)
    assert exposures.stated_gain(short, capture / "long" / "000.png") is None
    # what the capture says goes before
    assert replace(exposures, long_iso=800.0).stated_gain(short, long) == pytest.approx(20 / 2)


# --- fusing -----------------------------------------------------------------------------------------------------------


def test_pairs_become_pictures_of_the_short_ones_names(written, tmp_path):
    folder, scenes = written
    steps = []
    pairs = fuse_exposure_capture(folder, tmp_path / "out", fuser=AVERAGE, progress=lambda *step: steps.append(step))
    assert steps[-1] == ("fusing", 3, 3)
    assert [pair.name for pair in pairs] == ["000.png", "001.png", "002.png"] and all(pair.fused for pair in pairs)
    for pair, scene in zip(pairs, scenes, strict=True):
        assert pair.by_gyro and pair.blur_px > 3 and pair.gain == pytest.approx(GAIN, rel=0.02)
        assert pair.gain_stated == pytest.approx(GAIN) and pair.agreement > pair.agreement_before
        assert f"fused with {pair.name}" in str(pair.reason) and "aligned by the gyroscope" in str(pair.reason)
        inner = (slice(12, -12), slice(12, -12))
        fused, sharp = read(tmp_path / "out" / "images" / pair.name)[inner], scene.sharp()[inner]
        naive = 0.5 * (read(folder / "short" / pair.name).astype(float) + read(folder / "long" / pair.name))[inner]
        assert psnr_db(fused, sharp) > psnr_db(naive, sharp) + 4
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["fuser"] == "average" and "aligned by the gyroscope and the pixels" in result["note"]
    assert [frame["name"] for frame in result["frames"]] == ["000.png", "001.png", "002.png"]
    assert find_violations("exposures", result) == []
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputExistsError):
        fuse_exposure_capture(folder, tmp_path / "mine", fuser=AVERAGE, progress=silent)


def test_pictures_alone_are_enough(capture, tmp_path):
    text = (capture / "capture.toml").read_text()
    alone = '[images]\nfolder = "short"\n[exposures]\nfolder = "long"\n'
    (capture / "capture.toml").write_text(alone)
    pairs = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert all(pair.fused and pair.by_pixels and not pair.by_gyro and pair.blur_px is None for pair in pairs)
    assert pairs[0].gain == pytest.approx(GAIN, rel=0.05) and pairs[0].gain_stated is None
    note = json.loads((tmp_path / "out" / "result.json").read_text())["note"]
    assert "by the pixels alone: the frames have no times" in note
    # times without those of the long ones
    (capture / "capture.toml").write_text(text.replace('times = "long.csv"\n', ""))
    fuse_exposure_capture(capture, tmp_path / "timed", fuser=AVERAGE, progress=silent)
    note = json.loads((tmp_path / "timed" / "result.json").read_text())["note"]
    assert "start or length of the long exposures is unknown" in note


def test_exposure_times_tell_the_gain_without_a_gyroscope_too(capture, tmp_path):
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text(text.replace('[imu]\npath = "imu.csv"\n', ""))
    pairs = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert not pairs[0].by_gyro and pairs[0].gain_stated == pytest.approx(GAIN)


def test_pictures_of_another_size_than_the_camera_s_are_named(capture, tmp_path):
    for folder in ("short", "long"):
        path = capture / folder / "001.png"
        cv2.imwrite(str(path), cv2.imread(str(path))[:100])
    with pytest.raises(FormatError, match=r"short/001.png: is 240x100, but the camera is 240x160"):
        fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)


def test_colmap_is_quiet_while_it_looks_for_the_calibration(capture, tmp_path, monkeypatch):
    import pycolmap

    before, levels = pycolmap.logging.minloglevel, []

    def look(*args, **options):
        levels.append(pycolmap.logging.minloglevel)
        raise NotObservableError("calibration", Fact.stated("so"))

    monkeypatch.setattr(plan, "estimate_preliminary_calibration", look)
    pycolmap.logging.minloglevel = 0
    try:
        fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    finally:
        pycolmap.logging.minloglevel = before
    assert levels == [pycolmap.logging.Level.FATAL.value]


def test_a_stated_gain_that_the_pixels_deny_is_said(capture, tmp_path):
    changed(capture, ("short_iso = 1600", "short_iso = 100"))
    pairs = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert "give 192 times, which the pixels contradict" in str(pairs[0].reason)
    assert pairs[0].gain == pytest.approx(GAIN, rel=0.05)


def test_fusion_brings_back_what_clips(written, tmp_path):
    folder, _ = written
    clipping = Fuser(fuse=lambda short, long, blur: long, identity="long")
    for fusion in ("none", "mertens"):
        options = ExposureOptions(fusion=fusion)
        fuse_exposure_capture(folder, tmp_path / fusion, options, fuser=clipping, progress=silent)
    clipped = [(read(tmp_path / fusion / "images" / "000.png") >= 250).mean() for fusion in ("none", "mertens")]
    assert clipped[1] < clipped[0]


def test_of_a_pair_that_shows_different_things_the_better_one_is_taken(capture, tmp_path):
    rng = np.random.default_rng(0)
    other = cv2.resize(rng.uniform(20, 220, (20, 30, 3)), (240, 160), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(capture / "long" / "001.png"), np.clip(other, 0, 255).astype(np.uint8))
    first, second = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert first.fused and not second.fused and second.reason.values["why"].code == "pair-not-alike"
    # the short one, as bright as the long one
    assert second.used == "short" and str(second.reason).startswith("is the short exposure, ")
    kept, dark = (read(folder / "001.png") for folder in (tmp_path / "out" / "images", capture / "short"))
    assert second.gain == pytest.approx(GAIN) and kept.mean() > 2.5 * dark.mean()


def test_in_place_of_a_black_short_exposure_the_long_one_is_taken(capture, tmp_path):
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text("\n".join(line for line in text.splitlines() if "_iso" not in line))
    cv2.imwrite(str(capture / "short" / "000.png"), np.zeros((160, 240, 3), np.uint8))
    first, second = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert not first.fused and first.used == "long" and second.fused and second.used == "both"
    assert str(first.reason).startswith("is the long exposure as it is, not fused: too few pixels")
    images = [read(folder / "000.png") for folder in (tmp_path / "out" / "images", capture / "long")]
    assert np.array_equal(*images)


def test_damaged_and_unlike_partners_are_named(capture, tmp_path):
    def fuse(name):
        fuse_exposure_capture(capture, tmp_path / name, fuser=AVERAGE, progress=silent)

    path = capture / "long" / "001.png"
    whole = cv2.imread(str(path))
    cv2.imwrite(str(path), whole[:100])
    with pytest.raises(FormatError, match=r"001.png: is 240x100, but its short exposure 001.png is 240x160"):
        fuse("size")
    cv2.imwrite(str(path), whole[..., 0])
    with pytest.raises(FormatError, match=r"001.png: is grey, but its short exposure 001.png is in colour"):
        fuse("grey")
    cv2.imwrite(str(path), whole.astype(np.uint16) * 256)
    with pytest.raises(FormatError, match="write both with the same depth"):
        fuse("depth")
    data = (capture / "long" / "000.png").read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"long/001.png: is cut off"):
        fuse("cut")
    path.unlink()
    with pytest.raises(FormatError, match=r"the long exposure of 001.png is missing"):
        fuse("missing")
    assert not (tmp_path / "missing").exists()
    (capture / "capture.toml").write_text('[images]\nfolder = "short"\n')
    with pytest.raises(FormatError, match=r"no pairs of exposures: add .images. and .exposures."):
        fuse("none")


def test_a_full_disk_is_told(capture, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(frame_folder, "encode_image", full)
    with pytest.raises(OutputError, match=r"is full .* free some space and start again; the run continues"):
        fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)


def test_a_stopped_run_is_gone_on_with_and_ends_as_if_undisturbed(capture, tmp_path):
    fuse_exposure_capture(capture, tmp_path / "whole", fuser=AVERAGE, progress=silent)

    def stop(stage, done, total, /):
        if stage == "fusing" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=stop)
    assert not (tmp_path / "out" / "images").exists() and not (tmp_path / "out" / "result.json").exists()
    pairs = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=silent)
    assert contents(tmp_path / "out" / "images") == contents(tmp_path / "whole" / "images")
    before = (tmp_path / "out" / "result.json").read_bytes()
    # nothing is left to do; another fusion makes the pictures again where that is asked for
    stages = []
    again = fuse_exposure_capture(capture, tmp_path / "out", fuser=AVERAGE, progress=lambda s, *_: stages.append(s))
    assert again == pairs and stages == [] and (tmp_path / "out" / "result.json").read_bytes() == before
    options = ExposureOptions(fusion="mertens")
    with pytest.raises(OutputExistsError, match=r"fusion = mertens \(was none\)"):
        fuse_exposure_capture(capture, tmp_path / "out", options, fuser=AVERAGE, progress=silent)
    assert contents(tmp_path / "out" / "images") == contents(tmp_path / "whole" / "images")
    fuse_exposure_capture(capture, tmp_path / "out", options, fuser=AVERAGE, overwrite=True, progress=silent)
    assert contents(tmp_path / "out" / "images") != contents(tmp_path / "whole" / "images")
    with Workspace(tmp_path / "out").locked(), pytest.raises(OutputExistsError, match="another run is at work"):
        fuse_exposure_capture(capture, tmp_path / "out", options, fuser=AVERAGE, progress=silent)


def test_the_stage_keeps_order_and_a_bounded_number_of_frames(written):
    folder, _ = written
    loaded = load_capture(folder)
    taken, yielded = [], []

    def frames():
        for frame in read_frames(loaded)[1]:
            for copy in range(2):
                taken.append(frame.name)
                assert len(taken) - len(yielded) <= 4, copy
                yield frame

    stage = ExposureStage(pictures=loaded.exposures, folder=folder / "short", fuser=AVERAGE, workers=2)
    for frame in stage(frames()):
        yielded.append(frame.name)
        assert frame.image.dtype == np.uint8 and "fused" in str(frame.treatments[-1].reason)
    assert yielded == taken == [name for name in ("000.png", "001.png", "002.png") for _ in range(2)]


# --- reconstruct and the command line ---------------------------------------------------------------------------------

OPTIONS = ReconstructOptions(force=True, rolling_shutter="off", deterministic=True)


def stop(stage, done, total, /):
    if stage == "features":
        raise KeyboardInterrupt


@pytest.fixture
def by_average(monkeypatch):
    monkeypatch.setattr(driver, "lsd2_fuser", lambda options: AVERAGE)
    monkeypatch.setattr(images_alone, "lsd2_fuser", lambda options: AVERAGE)


def test_reconstruct_fuses_before_it_looks_for_features(written, tmp_path, by_average):
    folder, _ = written
    out, alone = tmp_path / "out", tmp_path / "alone"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, out, OPTIONS, progress=stop)
    fuse_exposure_capture(folder, alone, progress=silent)
    assert contents(out / "colmap" / "images") == contents(alone / "images")
    decided = json.loads((out / "imaging.json").read_text())
    assert decided["deblur"] == "short and long exposures are fused, aligned by the gyroscope and the pixels"
    records = json.loads((out / "frames.json").read_text())["frames"]
    assert {r["action"] for r in records} == {"changed"}
    assert all("aligned by the gyroscope" in r["treatments"][-1]["reason"] for r in records)


def test_another_long_exposure_makes_the_frames_again(written, tmp_path, by_average):
    out = tmp_path / "out"
    capture = shutil.copytree(written[0], tmp_path / "three")
    with pytest.raises(KeyboardInterrupt):
        reconstruct(capture, out, OPTIONS, progress=stop)
    before = contents(out / "colmap" / "images")
    brighter = read(capture / "long" / "001.png")[..., ::-1] // 2
    cv2.imwrite(str(capture / "long" / "001.png"), brighter)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(capture, out, OPTIONS, progress=stop)
    after = contents(out / "colmap" / "images")
    assert [name for name in before if before[name] != after[name]] == ["001.png"]


def test_the_short_exposures_alone_where_asked(written, tmp_path):
    folder, _ = written
    options = replace(OPTIONS, deblur="off", exposures=ExposureOptions(fuse=False))
    with pytest.raises(KeyboardInterrupt):
        reconstruct(folder, tmp_path / "out", options, progress=stop)
    assert contents(tmp_path / "out" / "colmap" / "images") == contents(folder / "short")


def test_deblurring_needs_no_long_exposures(written, tmp_path):
    shutil.copytree(written[0], tmp_path / "capture")
    (tmp_path / "capture" / "long" / "001.png").unlink()
    done = deblur_capture(tmp_path / "capture", tmp_path / "out", progress=silent)
    assert contents(done.workspace.images) == contents(tmp_path / "capture" / "short")


def test_a_fused_frame_is_not_deblurred_again(written, tmp_path):
    folder, _ = written
    with pytest.raises(InertialError, match="are fused, not deblurred"):
        reconstruct(folder, tmp_path / "out", replace(OPTIONS, deblur="wiener"), progress=silent)
    assert not (tmp_path / "out").exists()


def test_a_missing_partner_or_network_is_said_before_the_work(capture, tmp_path, monkeypatch, capsys):
    def missing(*args, **options):
        raise MissingExtraError("restore", Fact.stated("networks need onnxruntime"))

    monkeypatch.setattr("colmap_inertial.run.stages.inputs.load_network", missing)
    for command in ("reconstruct", "fuse-exposures"):
        with pytest.raises(SystemExit) as end:
            main([command, str(capture), str(tmp_path / "out")])
        assert end.value.code == 2 and "pip install 'onnxruntime>=" in capsys.readouterr().err
    (capture / "long" / "001.png").unlink()
    with pytest.raises(SystemExit):
        main(["reconstruct", str(capture), str(tmp_path / "out")])
    assert "the long exposure of 001.png is missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_package_s_network_is_used_and_named(capture, tmp_path, monkeypatch):
    small.write_weights(tmp_path / "weights", lsd2=small.mixing(0.5))
    monkeypatch.setattr(shipped, "folder", lambda: tmp_path / "weights")
    fuse_exposure_capture(capture, tmp_path / "net", ExposureOptions(device="cpu"), progress=silent)
    guarded = Fuser(fuse=lambda short, *other: replace_departures(average(short, *other), short), identity="guarded")
    fuse_exposure_capture(capture, tmp_path / "mean", fuser=guarded, progress=silent)
    for name in ("000.png", "001.png"):
        two = [read(tmp_path / out / "images" / name).astype(int) for out in ("net", "mean")]
        assert np.abs(two[0] - two[1]).max() <= 1
    assert (
        json.loads((tmp_path / "net" / "result.json").read_text())["fuser"]
        == f"lsd2 {shipped.checksum('lsd2')}, short where departing"
    )


def test_the_command_fuses_and_says_what_it_did(capture, tmp_path, by_average, capsys):
    cv2.imwrite(str(capture / "short" / "000.png"), np.zeros((160, 240, 3), np.uint8))
    text = (capture / "capture.toml").read_text()
    (capture / "capture.toml").write_text("\n".join(line for line in text.splitlines() if "_iso" not in line))
    with pytest.raises(SystemExit) as end:
        main(["fuse-exposures", str(capture / "capture.toml"), str(tmp_path / "out"), "--fusion", "mertens"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert "1 of 2 pairs fused" in shown and "000.png is the long exposure as it is" in shown
    assert json.loads((tmp_path / "out" / "result.json").read_text())["fusion"] == "mertens"
