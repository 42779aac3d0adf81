"""Rotation from pixels, and what it tells about the gyroscope beside the camera."""

import re
import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import matrix_from_quat, quat_conjugate, quat_log, quat_multiply, so3_exp
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.types import CameraModel, Frame, FrameTiming, ImuRecording
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.motion.align import AlignOptions, align_camera_imu
from colmap_inertial.motion.flow import (
    FlowOptions,
    _fit_rate,
    check_motion,
    find_stabilisation,
    measure_rotation,
    reduce_frames,
)
from colmap_inertial.motion.shutter import estimate_readout
from colmap_inertial.tools.simulate.render import colmap_camera
from tests.helpers.far_scene import FarScene

LENS = CameraModel(model="OPENCV", width=320, height=240, params=(250, 252, 161, 119, 0.12, -0.2, 0.001, -0.0005))
FISHEYE = CameraModel(model="OPENCV_FISHEYE", width=320, height=240, params=(140, 140, 161, 119, 0.02, -0.01, 0, 0))


def filmed(scene, model=LENS, *, rate_hz=15.0, readout_s=0.03, begin_s=0.3, end_s=3.7):
    """Frames and their timing."""
    t_s = np.arange(begin_s, end_s, 1 / rate_hz)
    names = tuple(f"{i:03}.png" for i in range(len(t_s)))
    timing = FrameTiming(names=names, t_s=t_s, exposure_s=np.full(len(t_s), 0.004), readout_s=readout_s)
    frames = [
        Frame(name=name, image=scene.picture(model, FrameShutter.of(timing, i, width=320, height=240)), t_s=t_s[i])
        for i, name in enumerate(names)
    ]
    return frames, timing


def true_turns(scene, timing):
    q = scene.motion.world_from_cam_xyzw(timing.pose_t_s())
    return quat_log(quat_multiply(quat_conjugate(q[:-1]), q[1:]))


def recorded(gyro, *, noise_rad_s=0.003):
    """The gyroscope of a ``GyroCamera`` as a recording on its own clock."""
    rate = gyro.path.rate_rad_s + noise_rad_s * np.random.default_rng(5).standard_normal(gyro.path.rate_rad_s.shape)
    return ImuRecording(gyro_t_s=gyro.path.t_s, gyro_rad_s=rate, accel_t_s=[], accel_m_s2=np.zeros((0, 3)))


@pytest.fixture(scope="module")
def scene():
    return FarScene.make()


@pytest.fixture(scope="module")
def film(scene):
    return filmed(scene)


@pytest.fixture(scope="module")
def rotation(film):
    """What its pictures tell."""
    frames, timing = film
    return measure_rotation(reduce_frames(frames), colmap_camera(LENS), timing)


@pytest.mark.parametrize("model", [LENS, FISHEYE], ids=lambda m: m.model)
def test_rotations_are_right_with_any_lens_and_a_rolling_shutter(scene, film, rotation, model):
    frames, timing = film if model is LENS else filmed(scene, model)
    if model is not LENS:
        rotation = measure_rotation(reduce_frames(frames), colmap_camera(model), timing)
    error = rotation.turn_rad - true_turns(scene, timing)
    assert np.isfinite(error).all()
    # a pixel is 4 mrad; the rate changes while a frame is read
    assert np.median(np.linalg.norm(error, axis=1)) < 3e-3
    ignoring = measure_rotation(reduce_frames(frames), colmap_camera(model), replace(timing, readout_s=0.0))
    blind = ignoring.turn_rad - true_turns(scene, timing)
    assert np.sqrt(np.mean(error**2)) < 0.85 * np.sqrt(np.mean(blind**2))


def test_frames_far_apart_are_matched_by_features(scene):
    frames, timing = filmed(scene, rate_hz=3.0)
    rotation = measure_rotation(reduce_frames(frames), colmap_camera(LENS), timing, FlowOptions(corners=300))
    error = np.linalg.norm(rotation.turn_rad - true_turns(scene, timing), axis=1)
    assert np.linalg.norm(rotation.turn_rad, axis=1).max() > 0.2
    assert np.isfinite(error).mean() > 0.8 and np.nanmedian(error) < 1e-2


def test_the_gyroscope_is_aligned_before_any_reconstruction_exists(scene, rotation):
    track = rotation.trajectory()
    gyro = scene.gyro(late_s=0.0)
    found = align_camera_imu(track, recorded(gyro))
    assert found.gyro_time_offset_s == pytest.approx(-11.0, abs=min(0.003, 4 * found.sigma("gyro_time_offset_s")))
    turn = quat_log(quat_multiply(found.cam_from_imu_xyzw, quat_conjugate(gyro.cam_from_imu_xyzw)))
    assert np.linalg.norm(turn) < np.radians(1.5)


def test_the_readout_is_found_in_the_pictures(scene, rotation):
    found = estimate_readout(rotation, scene.gyro(noise_rad_s=0.003))
    assert abs(found.readout_s - 0.03) < max(3 * found.sigma_s, 1e-3) and found.direction == "down"


def test_a_pair_that_tells_nothing_breaks_the_chain_and_the_longest_run_is_kept(scene, film):
    frames, timing = film
    frames = list(frames)
    frames[10] = replace(frames[10], image=np.full((240, 320, 3), 90, np.uint8))
    rotation = measure_rotation(reduce_frames(frames), colmap_camera(LENS), timing)
    assert np.isnan(rotation.turn_rad[9:11]).all() and np.isfinite(rotation.turn_rad[11:]).all()
    track = rotation.trajectory()
    assert track.names == timing.names[11:]
    np.testing.assert_array_equal(track.t_s, timing.pose_t_s()[11:])
    blank = [replace(frame, image=np.full((240, 320), 90, np.uint8)) for frame in frames[:8]]
    with pytest.raises(NotObservableError, match="too few corners"):
        measure_rotation(reduce_frames(blank), colmap_camera(LENS), timing).trajectory()


def test_pictures_without_the_gyroscope_s_rotation_were_stabilised(scene, rotation):
    imu = recorded(scene.gyro())
    for offset_s in (None, -11.0):
        finding = find_stabilisation(rotation, imu, offset_s=offset_s)
        assert finding.stabilised is False and finding.share == pytest.approx(1.0, abs=0.15)
    # a stabiliser lets the mean over a second pass
    smooth = np.stack([np.convolve(c, np.ones(15) / 15, mode="same") for c in rotation.turn_rad.T], axis=1)
    finding = find_stabilisation(replace(rotation, turn_rad=smooth), imu)
    assert finding.stabilised is True and finding.reason.code == "pictures-stabilised"
    still = replace(imu, gyro_rad_s=0.01 * imu.gyro_rad_s)
    assert find_stabilisation(rotation, still).stabilised is None
    assert find_stabilisation(replace(rotation, t_s=rotation.t_s * 10), imu).stabilised is None


def test_a_flipped_axis_is_told_from_the_way_between_frames(scene, rotation):
    gyro = scene.gyro()
    right = check_motion(rotation, gyro)
    assert right.agrees and right.explained > 0.98
    np.testing.assert_allclose(right.gain, 1, atol=0.08)
    to_cam = matrix_from_quat(gyro.cam_from_imu_xyzw)
    for axis in range(3):
        sign = np.ones(3)
        sign[axis] = -1
        rate = gyro.path.rate_rad_s @ to_cam.T * sign @ to_cam
        flipped = check_motion(rotation, replace(gyro, path=GyroPath(gyro.path.t_s, rate, np.zeros(3))))
        assert not flipped.agrees and flipped.reason.values["flipped"] == ("xyz"[axis],)
    elsewhere = check_motion(rotation, replace(gyro, offset_s=gyro.offset_s + 0.7))
    assert not elsewhere.agrees
    assert check_motion(rotation, replace(gyro, offset_s=100.0)).agrees is None


def test_one_pair_that_was_measured_wrongly_flips_no_axis(scene, rotation):
    turn = rotation.turn_rad.copy()
    turn[5] = [0.5, -2.0, 0.4]
    found = check_motion(replace(rotation, turn_rad=turn), scene.gyro())
    assert found.agrees and found.explained > 0.98
    np.testing.assert_allclose(found.gain, 1, atol=0.08)


def test_memory_does_not_grow_with_the_number_of_frames(film):
    frames, timing = film

    def peak(count):
        stream = (replace(frames[i], image=frames[i].image.copy()) for i in range(count))
        tracemalloc.start()
        measure_rotation(reduce_frames(stream), colmap_camera(LENS), timing)
        out = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return out

    peak(5)
    assert peak(24) < 1.2 * peak(8)


def test_gyrostab_s_axes_and_offset_are_found(shared_data):
    folder = shared_data / "gyrostab" / "20200109_145447"
    gyro = np.loadtxt(folder / "gyro.txt", delimiter=",")
    stamps_s = np.loadtxt(folder / "framestamp.txt")
    exposure_s = dict(re.findall(r"SOF\s+(\d+),.*exp time ([\d.]+)", (folder / "gyro_dump.txt").read_text()))
    names = tuple(f"RE_frame-{n}.jpg" if n > 99 else "RE_frame-099.jpg" for n in range(99, 159))
    names = tuple(name if (folder / "reshape" / name).exists() else "RE_frame-99.jpg" for name in names)
    t_s = stamps_s[98:158]
    timing = FrameTiming(
        names=names,
        t_s=t_s - stamps_s[0],
        exposure_s=[float(exposure_s[str(round(t * 1e6))]) for t in t_s],
        readout_s=0.0333,
    )
    imu = ImuRecording(
        gyro_t_s=gyro[:, 3] - stamps_s[0], gyro_rad_s=gyro[:, :3], accel_t_s=[], accel_m_s2=np.zeros((0, 3))
    )
    camera = CameraModel(model="PINHOLE", width=800, height=600, params=(573.85, 575.04, 406.01, 309.01))
    frames = (
        Frame(name=name, image=cv2.imread(str(folder / "reshape" / name))[..., ::-1], t_s=t)
        for name, t in zip(names, timing.t_s, strict=True)
    )
    rotation = measure_rotation(reduce_frames(frames), colmap_camera(camera), timing)
    found = align_camera_imu(rotation.trajectory(), imu, options=AlignOptions(max_offset_s=1.0))
    axes = matrix_from_quat(found.cam_from_imu_xyzw)
    np.testing.assert_allclose(axes, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=0.08)
    assert 0.004 < found.gyro_time_offset_s < 0.016
    finding = find_stabilisation(rotation, imu, offset_s=found.gyro_time_offset_s)
    assert finding.stabilised is False and finding.share == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("readout_s", [0.0, 0.002])
def test_a_rate_turns_each_ray_for_as_long_as_its_lines_lie_apart(readout_s):
    rng = np.random.default_rng(5)
    rate, pixel_rad = np.array([0.4, -1.2, 0.8]), 1e-3
    first = np.column_stack([rng.uniform(-0.6, 0.6, (400, 2)), np.ones(400)])
    span_s = 0.05 + readout_s * rng.uniform(-0.5, 0.5, 400)
    second = np.einsum("nij,nj->ni", so3_exp(-rate * span_s[:, None]), first)
    second[:40] += 0.2 * rng.standard_normal((40, 3))  # what moves by itself
    found, sigma, count = _fit_rate(first, second, span_s, pixel_rad)
    np.testing.assert_allclose(found, rate, atol=1e-3)
    assert sigma < 0.01 and 355 <= count <= 370
