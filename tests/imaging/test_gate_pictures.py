"""Nothing that is sharp gets worse, and what is blurred is still deblurred."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging import evidence
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.evidence import (
    BlurEvidence,
    _weigh_tiles,
    blur_evidence,
    measure_blur_share,
    measure_blur_shares,
)
from colmap_inertial.imaging.gate import (
    GATE_LIMITS,
    GateOptions,
    RecordingVerdict,
    decide,
    judge_frame,
    judge_recording,
    keep_sharp,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.psf import PredictedBlur, blur_field
from colmap_inertial.imaging.rolling_shutter import rectify_keypoints
from colmap_inertial.tools.simulate.render import colmap_camera
from scripts.common.gated_deblur import deblur_gated
from tests.helpers.far_scene import FarScene

WIDTH, HEIGHT = 800, 450
LENS = CameraModel(
    model="OPENCV", width=WIDTH, height=HEIGHT, params=(640, 640, 400, 225, 0.08, -0.12, 0.0005, -0.0003)
)
#: Pairs of instants at which the scene's camera turns quickly and looks at much the same.
PAIRS = {"a": (0.98, 1.14), "c": (3.58, 3.74)}


@cache
def scene():
    return FarScene.make(6, vigour=1.0, size=1600)


def scaled(field, factor):
    return replace(field, vector_px=field.vector_px * np.float32(factor))


@cache
def shot(t_s, blur_px):
    """Shutter and picture (1 % noise) of a frame whose 90th percentile of blur is ``blur_px``."""
    gyro, camera = scene().gyro(), colmap_camera(LENS)
    shutter = FrameShutter(width=WIDTH, height=HEIGHT, t_s=t_s, exposure_s=0.01, readout_s=0.015)
    length = float(np.percentile(blur_field(gyro, camera, shutter).extent_px(), 90))
    shutter = replace(shutter, exposure_s=0.01 * blur_px / length)
    assert shutter.exposure_s < 0.06
    picture = scene().picture(LENS, shutter, samples=max(2, int(1.4 * blur_px)), noise=0.01, seed=int(1e3 * t_s))
    picture.setflags(write=False)
    return shutter, picture


def flipped_gyro():
    gyro = scene().gyro()
    to_cam = matrix_from_quat(gyro.cam_from_imu_xyzw)
    rate = gyro.path.rate_rad_s @ to_cam.T * [-1, 1, 1] @ to_cam
    return replace(gyro, path=GyroPath(gyro.path.t_s, rate, np.zeros(3)))


def reversed_gyro(sign):
    """As if the recording had been played backwards."""
    gyro = scene().gyro()
    return replace(gyro, path=GyroPath(gyro.path.t_s, sign * gyro.path.rate_rad_s[::-1], np.zeros(3)))


def predicted(shutter, error):
    """The blur field as a gyroscope with an error says."""
    camera = colmap_camera(LENS)
    gyro = {
        "flipped axis": flipped_gyro,
        "noise": lambda: scene().gyro(noise_rad_s=0.2, seed=int(1e3 * shutter.t_s)),
        "backwards": lambda: reversed_gyro(1.0),
        "backwards, sign": lambda: reversed_gyro(-1.0),
        "10 ms late": lambda: scene().gyro(late_s=0.01),
    }.get(error, scene().gyro)()
    field = blur_field(gyro, camera, shutter)
    return scaled(field, {"20 % long": 1.2, "20 % short": 0.8}.get(error, 1.0))


def detect(image):
    points, descriptors = cv2.SIFT.create(2500).detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    root = np.sqrt(descriptors / descriptors.sum(axis=1, keepdims=True))
    return np.array([p.pt for p in points]) + 0.5, root


def correct_matches(images, shutters):
    """Mutual nearest neighbours that pass the ratio test and agree with the true motion to 3 px."""
    gyro, camera = scene().gyro(), colmap_camera(LENS)
    (xa, a), (xb, b) = (detect(image) for image in images)
    likeness = a @ b.T
    there, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    second, first = np.arccos(np.clip(np.partition(likeness, -2, axis=1)[:, -2:], -1, 1)).T
    good = np.flatnonzero((back[there] == np.arange(len(a))) & (first < 0.8 * second))
    at_a, at_b = (
        rectify_keypoints(x, gyro, camera, shutter)
        for x, shutter in ((xa[good], shutters[0]), (xb[there[good]], shutters[1]))
    )
    turns = [scene().wall_from_cam(np.array([s.reference_s()]))[0] for s in shutters]
    rays = np.concatenate([camera.cam_from_img(at_a)[:, :2], np.ones((len(good), 1))], axis=1)
    expected = camera.img_from_cam(rays @ turns[0].T @ turns[1])
    return int(np.sum(np.linalg.norm(expected - at_b, axis=1) < 3))


@cache
def untouched(pair, blur_px):
    shots = [shot(t, blur_px) for t in PAIRS[pair]]
    return correct_matches([s[1] for s in shots], [s[0] for s in shots])


def ratio(blur_px, error):
    """Correct matches through the gate against those without any deblurring, summed over the pairs."""
    shots = {pair: [shot(t, blur_px) for t in PAIRS[pair]] for pair in PAIRS}
    fields = {pair: [predicted(s, error) for s, _ in shots[pair]] for pair in PAIRS}
    verdict = judge_recording(
        blur_evidence(image, field)
        for pair in PAIRS
        for (_, image), field in zip(shots[pair], fields[pair], strict=True)
    )
    gated = before = 0
    for pair in PAIRS:
        images = [
            deblur_gated(image, field, recording=verdict).image
            for (_, image), field in zip(shots[pair], fields[pair], strict=True)
        ]
        before += untouched(pair, blur_px)
        same = all(a is b for a, (_, b) in zip(images, shots[pair], strict=True))
        gated += untouched(pair, blur_px) if same else correct_matches(images, [s for s, _ in shots[pair]])
    return gated / before


@pytest.mark.parametrize("blur_px", [6, 12])
def test_what_is_blurred_is_deblurred(blur_px):
    assert ratio(blur_px, "none") > {6: 1.15, 12: 1.4}[blur_px]


@pytest.mark.parametrize(
    "error", ["flipped axis", "noise", "20 % long", "20 % short", "10 ms late", "backwards", "backwards, sign"]
)
def test_a_wrong_gyroscope_loses_no_matches(error):
    assert ratio(12, error) >= 0.95


def test_a_sharp_frame_stays_as_it_is(subtests):
    for blur_px in (5, 10, 20):
        with subtests.test(blur_px=blur_px):
            for pair in PAIRS.values():
                shutter, image = shot(pair[0], 0.2)
                field = scaled(predicted(shutter, "none"), blur_px / 0.2)
                gated = deblur_gated(image, field)
                assert gated.image is image and not gated.deblurred and "does not show the blur" in str(gated.reason)


@pytest.mark.parametrize("blur_px", [6, 10, 20])
def test_a_sharp_frame_stays_as_it_is_among_blurred_ones(blur_px):
    trusted = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason=Fact.stated("others do"))
    for pair in PAIRS.values():
        shutter, image = shot(pair[0], 0.2)
        field = scaled(predicted(shutter, "none"), blur_px / 0.2)
        gated = deblur_gated(image, field, recording=trusted)
        assert gated.image is image and not gated.deblurred and gated.reason.code == "frame-sharp-along-blur"
        shutter, image = shot(pair[0], blur_px)
        assert deblur_gated(image, predicted(shutter, "none"), recording=trusted).deblurred


def test_a_sharp_frame_of_white_texture_stays_as_it_is_among_blurred_ones():
    """Gravel or grain has as much beyond all frequencies that blur takes: no fall is expected of it."""
    trusted = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason=Fact.stated("others do"))
    image = np.clip(128 + 40 * np.random.default_rng(0).standard_normal((720, 1280)), 0, 255).astype(np.uint8)
    vectors = np.broadcast_to(np.float32([12.0, 0.0]), (*BlurField.nodes(1280, 720, 16), 2))
    flat = BlurField(width=1280, height=720, vector_px=vectors)
    assert measure_blur_share(image, flat) is None
    gated = deblur_gated(image, flat, recording=trusted)
    assert gated.image is image and "does not show the blur" in str(gated.reason)


def test_the_image_tells_extent_and_direction(subtests):
    for blur_px in (10, 25):
        with subtests.test(blur_px=blur_px):
            shutter, image = shot(0.98, blur_px)
            field = predicted(shutter, "none")
            for factor in (0.8, 1.0, 1.2):
                evidence = blur_evidence(image, scaled(field, factor))
                assert evidence.support > 8 and evidence.extent_is_plausible
                assert evidence.extent_factor == pytest.approx(1 / factor, rel=0.06)
            turned = replace(field, vector_px=field.vector_px[..., ::-1] * np.float32([1, -1]))
            assert blur_evidence(image, turned).support < 4
            flipped = replace(field, vector_px=field.vector_px * np.float32([1, -1]))
            assert blur_evidence(image, flipped).mirrored_support == pytest.approx(
                blur_evidence(image, field).support, rel=0.2
            )


def test_tiles_are_weighed_once_for_the_blur_and_its_mirror_image(monkeypatch):
    weighed = []
    monkeypatch.setattr(evidence, "_weigh_tiles", lambda spectra: weighed.append(1) or _weigh_tiles(spectra))
    shutter, image = shot(0.98, 12)
    field = predicted(shutter, "none")
    shown, mirrored = measure_blur_shares(image, field)
    assert len(weighed) == 1
    monkeypatch.undo()
    flipped = replace(field, vector_px=field.vector_px * np.float32([1, -1]))
    assert shown == measure_blur_share(image, field)
    assert mirrored == pytest.approx(measure_blur_share(image, flipped), rel=1e-6)


def test_the_share_of_the_blur_that_shows_is_the_textures_and_not_the_sky_s(subtests):
    """Of a picture of which two thirds are a sky of noise, too."""
    for blur_px in (6, 12, 25):
        with subtests.test(blur_px=blur_px):
            field = predicted(shot(0.98, blur_px)[0], "none")
            shares = []
            for image in (shot(0.98, blur_px)[1], shot(0.98, 0.2)[1]):
                cloudless = image.copy()
                noise = 2 * np.random.default_rng(1).standard_normal((2 * HEIGHT // 3, WIDTH, 1))
                cloudless[: len(noise)] = np.rint(170 + noise).astype(np.uint8)
                shares += [measure_blur_share(image, field), measure_blur_share(cloudless, field)]
            blurred, blurred_below_sky, sharp, sharp_below_sky = shares
            assert 0.5 < blurred < 1.3 and 0.5 < blurred_below_sky < 1.3
            assert abs(sharp) < GATE_LIMITS.least_share / 2 and abs(sharp_below_sky) < GATE_LIMITS.least_share / 2
            flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
            assert measure_blur_share(flat, field) is None
            noise = np.random.default_rng(0).normal(128, 6, (HEIGHT, WIDTH)).astype(np.uint8)
            assert measure_blur_share(noise, field) is None


def judge_sky(image, seed):
    """The picture in its own shadow below a bright sky that takes most of it, with noise and JPEG."""
    rng = np.random.default_rng([seed, 7])
    light = 0.6 * (image.mean(axis=2) / 255) ** 2.2
    sky = round(0.6 * HEIGHT)
    light[:sky] = np.linspace(0.5, 0.7, sky)[:, None] + 0.02 * np.sin(np.arange(WIDTH) / 60)
    light += 0.01 * np.sqrt(0.5 + light) * rng.standard_normal(light.shape)
    codes = np.rint(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return cv2.imdecode(cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_GRAYSCALE)


def test_a_recording_that_is_mostly_sky_bears_its_gyroscope_out_and_no_other():
    found = {"none": [], "flipped axis": [], "sharp": []}
    for k, t_s in enumerate((0.98, 1.14, 3.58, 3.74, 2.3, 4.6)):
        shutter, image = shot(t_s, 8)
        for error in ("none", "flipped axis"):
            found[error].append(blur_evidence(judge_sky(image, k), predicted(shutter, error)))
        found["sharp"].append(blur_evidence(judge_sky(shot(t_s, 0.2)[1], k), predicted(shutter, "none")))
    trusted = {error: judge_recording(evidence).trusted for error, evidence in found.items()}
    assert trusted == {"none": True, "flipped axis": False, "sharp": False}
    # all tiles alike, it is not: the sky hides the rest
    alike = judge_recording([replace(one, standing=None) for one in found["none"]])
    assert alike.trusted is False


def test_tiles_weigh_by_what_stands_out_and_all_alike_where_nothing_does():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((60, 64, 33)).astype(np.float32)
    weights = _weigh_tiles(noise)
    assert weights.sum() == pytest.approx((weights**2).sum()) and weights.sum() > 55
    noise[:15] += np.log(50)
    weights = _weigh_tiles(noise)
    assert 15 < weights.sum() < 22 and weights[15:].max() < 0.1 < 0.9 < weights[:15].min()


def test_curved_blur_is_compared_with_the_curve():
    s = middles(33)
    curve = np.stack([12 * s + 24 * s**2 - 8 * s**3, 24 * s**3 - 8 * s**2], axis=1).astype(np.float32)
    nodes = BlurField.nodes(WIDTH, HEIGHT, 64)
    path = BlurPath(
        width=WIDTH, height=HEIGHT, path_px=np.broadcast_to(curve[:, None, None], (33, *nodes, 2)), step_px=64
    )
    sharp = shot(0.98, 0.2)[1].mean(axis=2).astype(np.float32) / 255
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    light = np.mean([cv2.remap(sharp, x + dx, y + dy, cv2.INTER_CUBIC) for dx, dy in curve], axis=0)
    noise = 0.01 * np.random.default_rng(2).standard_normal(light.shape)
    image = np.rint(255 * np.clip(light + noise, 0, 1)).astype(np.uint8)
    chord = path.field()
    assert path.departure_px() > 3
    assert measure_blur_share(image, path) > 0.5 > measure_blur_share(image, chord)
    curved, line = blur_evidence(image, path), blur_evidence(image, chord)
    assert curved.support > 6 and curved.extent_is_plausible and line.support < 2
    trusted = RecordingVerdict(trusted=True, support=9.0, extent_factor=1.0, frames=9, reason=Fact.stated("others do"))
    assert judge_frame(image, chord, trusted, GateOptions(), path)[0] == 1.0
    assert judge_frame(image, chord, None, GateOptions(), path)[0] is not None
    assert judge_frame(image, chord, None, GateOptions())[0] is None
    # a picture that is sharp, or blurred along another curve, shows it no more for that
    still = np.rint(255 * sharp).astype(np.uint8)
    across = replace(path, path_px=path.path_px[..., ::-1])
    for picture, other in ((still, path), (image, across)):
        assert (
            measure_blur_share(picture, other) < GATE_LIMITS.least_share and blur_evidence(picture, other).support < 4
        )


def test_a_wrong_extent_is_corrected_and_a_right_one_left_alone():
    shutter, image = shot(0.98, 12)
    field = predicted(shutter, "none")
    assert deblur_gated(image, field).extent_factor == 1.0
    assert deblur_gated(image, scaled(field, 0.8)).extent_factor == pytest.approx(1.25, rel=0.06)
    right, mended = (deblur_gated(image, scaled(field, k)).image.astype(int) for k in (1.0, 1.25))
    assert np.abs(right - mended).mean() < 1.5


def test_grey_and_16_bit_pictures_and_very_long_blur_are_judged_alike():
    shutter, image = shot(0.98, 12)
    field = predicted(shutter, "none")
    colour = blur_evidence(image, field)
    grey = blur_evidence(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), field)
    deep = blur_evidence(image.astype(np.uint16) * 257, field)
    assert grey.support == pytest.approx(colour.support, rel=0.05)
    assert deep.support == pytest.approx(colour.support, rel=0.06)
    shutter, image = shot(0.98, 25)
    large = cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    field = predicted(shutter, "none")
    vectors = cv2.resize(field.vector_px, BlurField.nodes(3 * WIDTH, 3 * HEIGHT)[::-1]) * 3
    evidence = blur_evidence(large, BlurField(width=3 * WIDTH, height=3 * HEIGHT, vector_px=vectors))
    assert evidence.support > 8 and evidence.extent_factor == pytest.approx(1.0, abs=0.08)


def test_flat_small_and_clipped_pictures_tell_nothing():
    field = BlurField.uniform(640, 480, (12.0, 3.0))
    for image in (np.full((480, 640), 90, np.uint8), np.full((480, 640, 3), 255, np.uint8)):
        evidence = blur_evidence(image, field)
        assert not evidence.enough and evidence.support == 0
        assert not deblur_gated(image, field).deblurred
    assert not blur_evidence(np.zeros((40, 50), np.uint8), BlurField.uniform(50, 40, (12.0, 3.0))).enough
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    assert not deblur_gated(noise, field).deblurred
    assert not deblur_gated(noise, BlurField.uniform(640, 480, (0.0, 0.0))).deblurred


def test_a_recording_is_judged_by_its_median_frame():
    shutter, image = shot(0.98, 12)
    right = blur_evidence(image, predicted(shutter, "none"))
    wrong = blur_evidence(image, predicted(shutter, "flipped axis"))
    assert judge_recording([right, right]).trusted is None
    assert judge_recording([right, wrong, right, BlurEvidence.nothing()]).trusted is True
    verdict = judge_recording([wrong, right, wrong])
    assert verdict.trusted is False and verdict.frames == 3 and verdict.reason.code == "blur-not-shown"
    assert not deblur_gated(image, predicted(shutter, "none"), recording=verdict).deblurred
    long = blur_evidence(image, scaled(predicted(shutter, "none"), 1.25))
    verdict = judge_recording([long, long, long])
    assert verdict.trusted and verdict.extent_factor == pytest.approx(0.8, rel=0.05) and "0.8" in str(verdict.reason)


def test_deepgyro_s_frames_show_a_fifth_more_blur_than_turning_explains(shared_data):
    """Its camera was swung at arm's length: near things move half as much again as turning explains, far ones 1.19."""
    folder = shared_data / "deepgyro" / "raw"
    stamps_ns, exposure_ns = np.loadtxt(folder / "images" / "images.txt").T
    rows = np.loadtxt(folder / "imu" / "imu.txt")
    gyro = rows[rows[:, 0] == 4, 1:]
    # published: camera x, y, z are the gyroscope's y, x, z; that mirrors, and the way between frames says the opposite
    path = GyroPath((gyro[:, 0] - gyro[0, 0]) * 1e-9, -gyro[:, [2, 1, 3]], np.zeros(3))
    motion = GyroCamera(path=path, cam_from_imu_xyzw=np.array([0, 0, 0, 1.0]), offset_s=0.022)
    intrinsics = (1558.6899, 1558.6899, 939.6533, 518.4131)
    camera = colmap_camera(CameraModel(model="PINHOLE", width=1920, height=1080, params=intrinsics))
    images, fields = [], []
    for i in range(1, 6):
        shutter = FrameShutter(
            width=1920,
            height=1080,
            t_s=(stamps_ns[i] - stamps_ns[0]) * 1e-9,
            exposure_s=exposure_ns[i] * 1e-9,
            readout_s=0.0244944,
        )
        fields.append(blur_field(motion, camera, shutter))
        images.append(cv2.imread(str(folder / "images" / f"{i + 1:04}.jpg")))
    verdict = judge_recording(blur_evidence(image, field) for image, field in zip(images, fields, strict=True))
    assert verdict.trusted and 1.12 < verdict.extent_factor < 1.28


def test_what_moved_with_the_camera_keeps_its_pixels():
    shutter, image = shot(0.98, 20)
    sharp = scene().picture(LENS, replace(shutter, exposure_s=0.0), noise=0.01)
    mixed = image.copy()
    mixed[160:320, 240:560] = sharp[160:320, 240:560]
    field = predicted(shutter, "none")
    out, share = keep_sharp(mixed, np.zeros_like(mixed), field)
    kept = (out > 0).any(axis=2)
    assert kept[192:288, 272:528].mean() > 0.3 and kept[:128].mean() < 0.05 and 0 < share < 0.2
    out, share = keep_sharp(image, np.zeros_like(image), field)
    assert share < 0.02


def test_blocks_of_a_sharp_edge_keep_their_pixels_and_fade_into_the_next(subtests):
    """A step among ramps as long as the blur: weights are one in the step's blocks, and linear to the next middles."""
    for dtype in (np.uint8, np.uint16):
        for vertical in (False, True):
            with subtests.test(dtype=dtype, vertical=vertical):
                top = 60000 if dtype == np.uint16 else 240
                ramp = top * (0.25 + 0.5 * np.clip((np.arange(320) - 140) / 40, 0, 1))
                image = np.tile(ramp, (192, 1))
                image[64:128] = np.where(np.arange(320) < 160, 0.25 * top, 0.75 * top)
                image = np.rint(image).astype(dtype)
                grey, length = (image.T, (0.0, 40.0)) if vertical else (image, (40.0, 0.0))
                field = BlurField.uniform(*grey.shape[::-1], length)
                out, share = keep_sharp(grey, np.zeros_like(grey), field)
                weight = (out / grey).T if vertical else out / grey
                rows = np.interp(np.arange(192), [47.5, 79.5, 111.5, 143.5], [0, 1, 1, 0])
                columns = np.interp(np.arange(320), [111.5, 143.5, 175.5, 207.5], [0, 1, 1, 0])
                assert np.abs(weight - rows[:, None] * columns).max() < 0.02
                assert share == pytest.approx(4 / 60)
                # three channels alike; without blur nothing is too sharp for it
                colour = np.repeat(grey[..., None], 3, axis=2)
                coloured, _ = keep_sharp(colour, np.zeros_like(colour), field)
                assert np.abs(coloured.astype(float) - out[..., None]).max() <= 0.01 * top
                assert keep_sharp(grey, np.zeros_like(grey), BlurField.uniform(*grey.shape[::-1], (0.0, 0.0)))[1] == 0


def blur_of(px, reasons=None):
    names = tuple(f"{i}.jpg" for i in range(len(px)))
    return PredictedBlur(names=names, px=np.array(px, dtype=float), reasons=tuple(reasons or [None] * len(px)))


def test_every_frame_has_a_decision_with_a_reason():
    px = [1.0, 10.0, 60.0, 10.0, np.nan]
    decisions = decide(
        blur_of(px, [None, None, None, None, Fact("exposure-unknown")]), np.arange(5) / 30, width=1920, height=1080
    )
    assert [d.action for d in decisions] == ["keep", "deblur", "drop", "deblur", "keep"]
    assert decisions[0].reason.code == "blur-too-short" and str(decisions[1].reason) == "10.0 px of blur"
    assert decisions[2].reason.code == "blur-too-long" and decisions[4].reason.code == "exposure-unknown"
    assert decisions[4].blur_px is None and decisions[2].blur_px == 60
    small = decide(blur_of(px[:4]), np.arange(4) / 30, width=640, height=360)
    assert [d.action for d in small] == ["keep", "deblur", "drop", "deblur"]
    # what is 3 px of 1920 are too few to be undone there
    actions = [d.action for d in decide(blur_of([1.1, 1.9, 2.1]), np.arange(3) / 30, width=640, height=360)]
    assert actions == ["keep", "keep", "deblur"]


def test_thresholds_that_make_no_sense_are_refused(subtests):
    for values, said in (
        ({"skip_below_own_px": -0.1}, "skip_below_own_px"),
        ({"skip_below_px": -0.1}, "skip_below_px"),
        ({"skip_below_px": 9.0, "drop_above_px": 9.0}, "drop_above_px"),
        ({"bridge_s": 0.0}, "bridge_s"),
        ({"bridge_deg": 0.0}, "bridge_deg"),
    ):
        with subtests.test(values=values, said=said):
            with pytest.raises(ValueError, match=said):
                GateOptions(**values)
            assert (
                GateOptions(skip_below_own_px=0.0, skip_below_px=0.0, bridge_s=1e-3, bridge_deg=1e-3).skip_below_px == 0
            )


def test_frames_that_bridge_a_gap_stay_the_least_blurred_first():
    t_s = np.arange(8) * 0.2
    px = [5, 60, 80, 50, 70, 90, 60, 5]
    decisions = decide(blur_of(px), t_s, width=1920, height=1080)
    kept = [i for i, d in enumerate(decisions) if d.action != "drop"]
    assert kept[0] == 0 and kept[-1] == 7 and max(np.diff(t_s[kept])) < 0.5 + 1e-9
    assert 3 in kept and 5 not in kept and decisions[3].reason.code == "blur-bridges-gap"
    none = decide(blur_of(px), t_s, width=1920, height=1080, options=GateOptions(bridge_s=10.0))
    assert [d.action for d in none].count("drop") == 6
    turning = decide(
        blur_of(px),
        t_s + 0.5,
        width=1920,
        height=1080,
        motion=scene().gyro(),
        options=GateOptions(bridge_s=10.0, bridge_deg=3.0),
    )
    assert [d.action for d in turning].count("drop") < 6


def test_a_black_or_featureless_image_is_left_alone_whatever_the_recording_says() -> None:
    trusted = RecordingVerdict(trusted=True, support=16.0, extent_factor=1.0, frames=9, reason=Fact.stated("others do"))
    noise = np.random.default_rng(1).normal(0, 3.0, (HEIGHT, WIDTH, 3))
    vector_px = np.zeros((*BlurField.nodes(WIDTH, HEIGHT, 64), 2))
    vector_px[..., 0] = 14.0
    blur = BlurField(width=WIDTH, height=HEIGHT, vector_px=vector_px, step_px=64)
    darker = np.linspace(150, 90, WIDTH)[None, :, None]
    for level in (0.0, 8.0, 120.0, darker):
        image = np.clip(np.rint(level + noise), 0, 255).astype(np.uint8)
        factor, why = judge_frame(image, blur, trusted, GateOptions())
        assert factor is None and why.code == "frame-blank"
    textured = shot(0.98, 0.2)[1]
    assert judge_frame(textured, blur, trusted, GateOptions())[1].code != "frame-blank"
