"""The parts of the benchmark of blur along paths that its figures stand on."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from rich.console import Console

from colmap_inertial.imaging.psf import blur_path
from colmap_inertial.tools.simulate import MotionOptions, make_motion
from scripts.benchmarks import path as bench_path
from scripts.common import path_false, path_methods, path_reconstructions, path_scenes, path_tables, recorded_orbits
from scripts.common.imaging_scenes import drawn_walls
from scripts.common.turning_world import Moment, Turning, TurningCamera
from scripts.restoration.handheld import Handheld

SIZE = (480, 270)


@cache
def turning():
    return Turning.simulated(3, duration_s=12.0)


@cache
def pair(exposure_s=0.033):
    moments = tuple(Moment(t_s=4.0 + 0.2 * k, exposure_s=exposure_s, readout_s=0.02) for k in (0, 1))
    camera = TurningCamera(
        wall=drawn_walls(1, 2)[0][:900, :1400],
        wall_from_world=np.eye(3),
        turning=turning(),
        size=SIZE,
        focal_px=0.78 * SIZE[0],
    )
    camera = replace(camera, wall_from_world=camera.facing(*moments))
    blur = float(np.mean([path_scenes.blur_px(camera, m) for m in moments]))
    return path_scenes.Pair(camera=camera, moments=moments, blur_px=blur, seed=5, cache=None)


def test_orientations_are_those_of_a_steady_turn():
    t_s = np.arange(0.0, 2.0, 0.005)
    rate = np.array([0.3, -1.1, 0.5])
    steady = Turning(t_s=t_s, rate_rad_s=np.tile(rate, (len(t_s), 1)))
    turn = steady.world_from_cam(np.array([1.234]))[0]
    axis, angle = rate / np.linalg.norm(rate), 1.234 * np.linalg.norm(rate)
    assert np.allclose(turn @ axis, axis) and np.trace(turn) == pytest.approx(1 + 2 * np.cos(angle))
    side = np.cross(axis, [1.0, 0, 0])
    assert np.cross(side, turn @ side) @ axis * np.sin(angle) > 0


def test_points_show_the_same_in_both_frames():
    one = pair()
    first, second = (one.camera.frame(m, 1) for m in one.moments)
    points = np.stack(np.meshgrid(np.arange(60.0, 420, 40), np.arange(60.0, 220, 40)), axis=-1).reshape(-1, 2)
    there = one.camera.transferred(points, *one.moments)
    seen = np.isfinite(there).all(axis=1)
    assert seen.sum() > 10 and np.abs(there - points)[seen].max() > 5
    a, b = (
        cv2.remap(image, p[seen, 0].astype(np.float32), p[seen, 1].astype(np.float32), cv2.INTER_CUBIC).ravel()
        for image, p in ((first, points), (second, there))
    )
    assert np.abs(a - b).max() < 0.02 + 0.1 * np.ptp(a)
    assert np.corrcoef(a, b)[0, 1] > 0.98


def reblurred(sharp, path, sign=1):
    """The mean of the sharp picture along the package's path."""
    width, height = SIZE
    q = path.at(np.arange(height), np.arange(width))
    q = sign * q
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    total = 0
    for k in range(q.shape[2]):
        maps = [(a + q[:, :, k, i]).astype(np.float32) for i, a in enumerate((x, y))]
        total = total + cv2.remap(sharp, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    return total / q.shape[2]


def test_the_package_s_path_makes_the_blurred_frame_of_the_sharp_one_and_no_other_does():
    one = pair(0.066)
    sharp, blurred = one.camera.frame(one.moments[0], 1), one.camera.frame(one.moments[0], 160)
    path = blur_path(*one.known(0, "exact"))
    assert one.blur_px > 8 and path.departure_px() > 0.3

    def error(sign=1):
        inside = (slice(40, -40),) * 2
        return float(np.sqrt(np.mean((reblurred(sharp, path, sign) - blurred)[inside] ** 2)))

    right = error()
    # light gathered at each instant of the frame's own line: the path has to be of the sharp frame's lines
    assert right < 0.01
    assert error(sign=-1) > 2 * right


def test_renderings_of_more_instants_are_the_same():
    one = pair()
    few, many = (one.camera.frame(one.moments[0], n) for n in (path_scenes.SAMPLES, 2 * path_scenes.SAMPLES))
    assert np.sqrt(np.mean((few - many) ** 2)) < 5e-4


def test_errors_of_the_gyroscope_are_all_there_and_of_fixed_size():
    one = pair()
    (motion, _, shutter), (late, _, longer) = one.known(0, "exact"), one.known(0, "errors")
    assert motion.offset_s == 0 and abs(late.offset_s) == pytest.approx(0.003)
    assert abs(longer.exposure_s / shutter.exposure_s - 1) == pytest.approx(0.1)
    assert longer.reference_s() == pytest.approx(shutter.reference_s())
    angle = 2 * np.arcsin(np.abs(late.cam_from_imu_xyzw[2]))
    assert np.degrees(angle) == pytest.approx(3)
    field = path_scenes.blur_px(one.camera, one.moments[0])
    exact = np.percentile(path_methods.blur_field(motion, *one.known(0, "exact")[1:]).extent_px(), 90)
    # the rolling shutter stretches the field of the package a little
    assert field == pytest.approx(exact, rel=0.1)


def test_every_method_gives_a_frame_for_features_and_one_for_people():
    one = pair()
    frame, sharp = one.frame(0), one.sharp(0)
    before = path_scenes_psnr(frame, sharp)
    for name in ("untreated, smoothed", "wiener", "path"):
        made = path_methods.METHODS[name](frame, *one.known(0, "exact"))
        assert made.for_features.shape == made.for_people.shape == frame.shape
        assert not np.array_equal(made.for_features, made.for_people)
        if name in ("wiener", "path"):
            assert path_scenes_psnr(made.for_people, sharp) > before


def path_scenes_psnr(a, b):
    return -10 * np.log10(np.mean(((a.astype(float) - b)[30:-30, 30:-30] / 255) ** 2))


def test_bins_and_summaries_are_of_all_pairs():
    assert [bench_path.binned(b) for b in (3.0, 7.9, 8.0, 24.9, 25.0, 60.0)] == [
        "3-8",
        "3-8",
        "8-15",
        "15-25",
        ">25",
        ">25",
    ]

    def one(place, before, after):
        def way(correct, db):
            return {"matches": {"0": [correct, 2 * correct]}, "psnr_db": db}

        return {"bin": place, "exposure_s": 0.016, "untreated": way(before, 20.0), "wiener, exact": way(after, 21.5)}

    found = bench_path.summary([one("3-8", 100, 150), one("3-8", 9, 39), one(">25", 1, 7)])
    assert found["wiener, exact"]["3-8"]["octave 0"]["ratio_of_sums"] == pytest.approx(189 / 109)
    assert found["wiener, exact"]["all"]["octave 0"]["median_ratio"] == pytest.approx(4.0)
    assert found["wiener, exact"]["all"]["gained_db"] == pytest.approx(1.5)
    assert found["untreated"][">25"]["pairs"] == 1 and found["wiener, exact"]["all"]["octave 0"]["precision"] == 0.5
    console = Console(width=200, record=True)
    path_tables.print_report({"about": {"seed": 0}, "quality": found}, console)
    assert "wiener, exact" in console.export_text()


def test_the_gate_and_the_cost_are_measured_of_the_same_pairs():
    take = path_scenes.Take(exposure_s=0.033, pairs=[pair()], beyond={"more": 0, "less": 0})
    found = path_methods.gate([take], bench_path.binned, console=Console(quiet=True))["33 ms"]
    assert sum(one["frames"] for one in found["treated"].values()) == 2
    assert found["sharp video"]["kept"] == 1.0


def test_reconstructions_are_compared_by_medians():
    scenes = path_reconstructions.scenes(8)
    assert len(scenes) == 8 and sorted(blur for _, blur in scenes.values()) == [10.0] * 4 + [20.0] * 4

    def way(registered, points, error):
        return {"registered": registered, "points": points, "centre_error_pct": error}

    found = {
        str(k): {
            "images": 10,
            "ways": {"as filmed": way(9, 100, 5.0), "rectified": way(n, 100, 0.5), "wiener": way(10, 160, 0.3)},
        }
        for k, n in enumerate((10, 9, 2))
    }
    values = {label: value for label, value, _, _ in path_reconstructions.wanted(found, "wiener")}
    assert values["wiener: camera error / rectified"] == pytest.approx(0.6)
    assert values["wiener: points / rectified"] == pytest.approx(1.6)
    assert values["wiener: least share of images registered"] == 1.0


def test_wrong_gyroscopes_are_wrong_in_their_own_way_and_skies_take_their_share():
    one = pair()
    middle_s = one.moments[0].t_s + 0.5 * one.moments[0].exposure_s
    steps = turning().rate_rad_s
    for name, wrong in path_false.WRONG.items():
        other = wrong(turning())
        assert len(other.t_s) == len(steps) and (np.diff(other.t_s) > 0).all(), name
        rates = [np.array([np.interp(middle_s, t.t_s, v) for v in t.rate_rad_s.T]) for t in (turning(), other)]
        assert np.linalg.norm(rates[1] - rates[0]) > 0.03 * np.linalg.norm(rates[0]), name
    twice = path_false.WRONG["backwards"](path_false.WRONG["backwards"](turning()))
    np.testing.assert_allclose(twice.rate_rad_s, steps)
    # all axes negative: the same line, and the curve about its middle turned by half a turn
    right, mirrored = (blur_path(*path_false.known_by(one, 0, wrong)) for wrong in (None, path_false.WRONG["sign"]))
    ends = [path.path_px[-1] - path.path_px[0] for path in (right, mirrored)]
    np.testing.assert_allclose(ends[1], -ends[0], atol=0.1 * np.abs(ends[0]).max())
    wall = drawn_walls(1, 2)[0]
    below = path_false.judge_sky(wall, 270, 0.7, seed=1)
    top = (len(wall) - 270) // 2
    same = np.abs(below - 0.35 * wall).max(axis=1)[top : top + 270] < 1e-6
    assert same.mean() == pytest.approx(0.3, abs=0.01) and not same[:180].any()


def test_a_recorded_hand_swings_about_the_simulator_s_orbit():
    t_s = np.arange(0.0, 9.0, 0.005)
    tilt = 0.05 * np.sin(2 * np.pi * 2.0 * t_s)
    rate = np.outer(np.gradient(tilt, t_s), [0.0, 1.0, 0.0]) @ recorded_orbits.BODY_FROM_CAM.T
    hand = Handheld(t_s=t_s, rate_rad_s=rate, velocity_m_s=np.zeros((len(t_s), 3)))
    turn, shift_m = recorded_orbits.swings(hand, np.arange(0.0, 9.0, 1 / 60))
    expected = np.interp(np.arange(0.0, 9.0, 1 / 60), t_s, tilt)
    np.testing.assert_allclose(turn[60:-60, 1], expected[60:-60], atol=0.006)
    assert np.abs(turn[60:-60, [0, 2]]).max() < 0.003 and np.abs(shift_m).max() < 1e-9
    options = MotionOptions(kind="orbit", duration_s=2.0, vigour=0.8)
    still = make_motion(replace(options, vigour=0.0), np.random.default_rng(1))
    held = recorded_orbits.orbit(options, np.random.default_rng(1), hand)
    at = np.linspace(-2.0, 4.0, 50)
    np.testing.assert_allclose(held.cam_in_world_m(at), still.cam_in_world_m(at), atol=1e-3)
    cosine = np.abs((held.world_from_cam_xyzw(at) * still.world_from_cam_xyzw(at)).sum(axis=1))
    assert 0.03 < 2 * np.arccos(np.clip(cosine, 0, 1)).max() < 0.07
