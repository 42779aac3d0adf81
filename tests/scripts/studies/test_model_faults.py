"""Real recordings with a wrong clock, gain, convention or model: a seeded part of ``studies/model_faults.py``."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.inertial.scale._shape import Scores, ShapeFault, find_faults
from colmap_inertial.inertial.scale.posterior import FittedPath
from colmap_inertial.io.trajectories import read_inertial_scale
from scripts.studies import model_faults as study


@pytest.fixture(scope="module")
def outcomes(shared_data):
    """What comes of a fault in clips of the recordings."""
    folder = shared_data / "real_imu"

    def of(fault, *, length_s, recordings="", sizes=None):
        clips = study.windows(folder, (length_s,), (study.NOISE_M,), most=1, first=7000)
        clips = [clip for clip in clips if clip.recording.startswith(recordings)]
        sizes = sizes or study.FAULTS[fault][0]
        altered = [study.Altered(window=w, fault=fault, size=size) for size in sizes for w in clips]
        return [study.run((folder, one)) for one in altered]

    return of


def test_a_wrong_clock_is_named_and_counted(outcomes):
    found = study.summary(outcomes("clock", length_s=15.0))
    assert found["n"] == 12 == found["named"]
    assert found["trusted"] == 0
    assert found["inside"] >= found["given"] - 2


def test_a_wrong_gain_is_named_and_counted_in_proportion_to_how_likely_it_is(outcomes):
    sizes = (0.01, 0.02, 0.03, -0.03, -0.05)
    every = outcomes("gain", length_s=20.0, sizes=sizes)
    found = {size: study.summary([o for o in every if o.altered.size == size]) for size in sizes}
    assert all(of["n"] == 6 and of["far"] == 0 for of in found.values())
    assert all(of["named"] == 6 for size, of in found.items() if abs(size) >= 0.03)
    assert found[-0.05]["trusted"] == 0
    # what sensors have is in the interval: a scale that is trusted all the same is right to within it
    assert all(of["wrong"] == 0 for size, of in found.items() if abs(size) >= 0.03)
    assert sum(of["inside"] for of in found.values()) >= 0.85 * sum(of["given"] for of in found.values())
    # the larger the fault, the wider the interval, without a step
    by_size = [[o.sigma for o in every if o.altered.size == size] for size in (0.01, 0.02, 0.03)]
    assert all(np.median(wide) > np.median(narrow) for narrow, wide in pairwise(by_size))


def test_a_large_bias_of_a_hand_that_turns_is_no_wrong_gain(outcomes):
    by_hand = outcomes("bias", length_s=30.0, recordings="room")
    assert len(by_hand) == 3 and not any(o.named for o in by_hand)
    assert all(o.verdict == "trusted" and abs(o.error) < Z95 * o.sigma for o in by_hand)


def test_arrays_in_another_convention_are_refused_by_name(outcomes):
    found = outcomes("wxyz", length_s=20.0, recordings=("room1", "MH03"))
    assert len(found) == 2 and all(o.verdict == "refused" and o.named for o in found)


@pytest.mark.parametrize(
    "fault, length_s", [("torn", 30.0), ("drift", 40.0), ("stretch", 30.0)], ids=["torn", "drift", "stretch"]
)
def test_a_wrong_shape_is_named_and_the_larger_part_keeps_its_metres(outcomes, fault, length_s):
    by_hand = outcomes(fault, length_s=length_s, recordings="room")
    large = [o for o in by_hand if o.altered.size >= 0.03]
    assert len(large) >= 6 and all(o.named and o.verdict == "weak" for o in large)
    assert all(abs(o.error) < Z95 * o.sigma for o in by_hand)


def test_a_torn_model_is_no_part_of_a_joined_one(shared_data):
    folder = shared_data / "real_imu"
    window = next(w for w in study.windows(folder, (40.0,), (study.NOISE_M,), most=1) if w.recording == "room3")
    trajectory, imu, truth = study.recorded(folder, window)
    metric = replace(trajectory, cam_in_world=trajectory.cam_in_world * truth)
    sound = FittedPath.of(metric, imu, None, ScaleOptions())
    assert sound.scale[0] == pytest.approx(1.0, abs=0.02)
    torn, _ = study.alter(study.Altered(window=window, fault="torn", size=0.05), metric, imu, 1.0)
    with pytest.raises(NotObservableError, match=r"reconstruction's scale (?:drifts|jumps|varies)"):
        FittedPath.of(torn, imu, None, ScaleOptions())


def test_sound_models_are_not_accused_and_single_wrong_centres_hardly_count(outcomes):
    assert not any(o.named for o in outcomes("clean", length_s=30.0))
    moved = study.summary(outcomes("moved", length_s=15.0))
    assert moved["named"] >= 5 and moved["given"] == 6 and moved["inside"] >= 5


def test_what_is_undone_is_what_was_done():
    """A path whose steps grew from some instant on, and one that was strained, are what they were."""
    rng = np.random.default_rng(3)
    t_s, path = np.arange(0.0, 40.0, 0.125), np.cumsum(rng.standard_normal((320, 3)), axis=0)
    by_break = ShapeFault(kind="break", at_s=25.0, value=np.array([0.05]), cov=np.eye(1), by_scale=np.zeros(1))
    steps = np.diff(path, axis=0) * np.exp(-0.05 * (t_s[1:] > 25.0))[:, None]
    torn = path[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    assert np.allclose(by_break.undo(t_s, torn), path)
    earlier = replace(by_break, at_s=10.0, keeps_after=True)
    assert np.allclose(np.diff(earlier.undo(t_s, path), axis=0)[100:], np.diff(path, axis=0)[100:])
    strain = ShapeFault(kind="stretch", value=0.01 * rng.standard_normal(5), cov=np.eye(5), by_scale=np.zeros(5))
    assert np.trace(strain.strain) == pytest.approx(0, abs=1e-12)
    bent = path @ np.linalg.inv(np.eye(3) + strain.strain)
    assert np.allclose(strain.undo(t_s, bent), path)


def test_vibration_makes_a_break_less_sure_and_no_larger():
    """Of an information and the score of a break by 5 %."""
    of = Scores(information=np.array([[1e4]]), score=np.array([1e4 * 0.05]), by_scale=np.zeros(1))
    t_s = np.arange(0.0, 40.0, 0.125)
    calm, shaken = (
        find_faults([("break", 20.0)], of, shaken=vibrates, t_s=t_s, taken=0.0)[0] for vibrates in (False, True)
    )
    assert calm.value == pytest.approx(0.05) and shaken.value == pytest.approx(0.05)
    assert calm.cov == pytest.approx(1e-4) and shaken.cov > 2 * calm.cov
    assert shaken.chi2(1.0) < 0.5 * calm.chi2(1.0)


@pytest.mark.parametrize("name, begin_s", [("D1", 50.0), ("D5", 0.0), ("D9", 50.0)])
def test_short_clips_are_not_taken_for_bent(shared_data, name, begin_s):
    """Ten seconds of sound recordings; a search for breaks and bends accuses these of 48."""
    folder = shared_data / "inertial_scale" / name
    trajectory, imu = read_inertial_scale(folder)
    since_s = trajectory.t_s - trajectory.t_s[0]
    clip = trajectory.select((since_s >= begin_s) & (since_s < begin_s + 10))
    estimate = estimate_scale(clip, imu, options=ScaleOptions(method="joint"))
    low, high = estimate.ci95
    assert low < float((folder / "groundtruth.txt").read_text()) < high
    assert not any(
        reason.code in ("model-stretched", "scale-grows", "scale-breaks", "scale-varies") for reason in estimate.reasons
    )
