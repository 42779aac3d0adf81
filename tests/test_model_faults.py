"""Real recordings with a wrong clock, gain, convention or model: a seeded part of ``study_model_faults.py``."""

import importlib
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.inertial.scale._inputs import align_recording
from colmap_inertial.inertial.scale._shape import ShapeFault, judge_breaks
from colmap_inertial.inertial.scale.joint import JointOptions, fit_path
from colmap_inertial.inertial.scale.posterior import FittedPath

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture(scope="module")
def study():
    """The script as a module; it imports its neighbours as it does on the command line."""
    sys.path.insert(0, str(SCRIPTS))
    try:
        return importlib.import_module("study_model_faults")
    finally:
        sys.path.remove(str(SCRIPTS))


@pytest.fixture(scope="module")
def outcomes(study, shared_data):
    """What comes of a fault in clips of the recordings."""
    folder = shared_data / "real_imu"

    def of(fault, *, length_s, most, first=7000):
        clips = study.windows(folder, (length_s,), (study.NOISE_M,), most=most, first=first)
        altered = [study.Altered(window=w, fault=fault, size=size) for size in study.FAULTS[fault][0] for w in clips]
        return [study.run((folder, one)) for one in altered]

    return of


def test_a_wrong_clock_is_named_and_counted(study, outcomes):
    found = study.summary(outcomes("clock", length_s=20.0, most=1))
    assert found["n"] == 12 == found["named"]
    assert found["trusted"] == 0
    assert found["inside"] >= found["given"] - 2


def test_a_wrong_gain_is_named_and_counted_in_proportion_to_how_likely_it_is(study, outcomes):
    every = outcomes("gain", length_s=20.0, most=1)
    found = {size: study.summary([o for o in every if o.altered.size == size]) for size in study.FAULTS["gain"][0]}
    assert all(of["n"] == 6 and of["far"] == 0 for of in found.values())
    large = [of for size, of in found.items() if abs(size) >= 0.03]
    assert all(of["named"] == 6 and of["trusted"] == 0 for of in large)
    assert sum(of["inside"] for of in found.values()) >= 0.85 * sum(of["given"] for of in found.values())
    # the larger the fault, the wider the interval, without a step
    by_size = [[o.sigma for o in every if o.altered.size == size] for size in (0.01, 0.02, 0.03)]
    assert all(np.median(wide) > np.median(narrow) for narrow, wide in pairwise(by_size))


def test_a_large_bias_of_a_hand_that_turns_is_no_wrong_gain(outcomes):
    by_hand = [o for o in outcomes("bias", length_s=40.0, most=1) if o.altered.window.recording.startswith("room")]
    assert len(by_hand) == 3 and not any(o.named for o in by_hand)
    assert all(o.verdict == "trusted" and abs(o.error) < Z95 * o.sigma for o in by_hand)


def test_arrays_in_another_convention_are_refused_by_name(study, outcomes):
    found = outcomes("wxyz", length_s=20.0, most=1)
    assert all(o.verdict == "refused" and "in the order w x y z" in o.said[0] for o in found)


def test_torn_flights_are_named_where_a_sound_one_is_not(study, shared_data):
    """Rotors shake the accelerometer: a break of 5 % is three standard deviations or more in V1_02 alone."""
    folder = shared_data / "real_imu"
    clips = [w for w in study.windows(folder, (40.0,), (study.NOISE_M,), most=2) if w.recording == "V102"]
    for fault, size, named in (("clean", 0.0, False), ("torn", 0.05, True)):
        found = [study.run((folder, study.Altered(window=w, fault=fault, size=size))) for w in clips]
        assert [o.named for o in found] == [named, named]
        assert all(o.verdict == ("weak" if named else "trusted") for o in found)


@pytest.mark.parametrize("recording", ["room3", "V102"])
def test_a_break_is_as_large_as_it_was_made(study, shared_data, recording):
    """The scan is linear, under vibration as well: what is put into a model is what it says more than before."""
    folder = shared_data / "real_imu"
    clips = study.windows(folder, (40.0,), (study.NOISE_M,), most=1)
    trajectory, imu, _ = study.recorded(folder, next(w for w in clips if w.recording == recording))
    timed, _ = align_recording(trajectory, imu, None, ScaleOptions())
    value = []
    for size in (0.0, 0.02):
        grown = size * np.clip((trajectory.t_s - trajectory.t_s[0] - 20) / 4 + 0.5, 0, 1)
        steps = np.diff(trajectory.cam_in_world, axis=0) * np.exp(grown[1:])[:, None]
        path = np.concatenate([trajectory.cam_in_world[:1], trajectory.cam_in_world[0] + np.cumsum(steps, axis=0)])
        _, fit, _ = fit_path(replace(trajectory, cam_in_world=path), timed, JointOptions())
        breaks = [one for one in fit.shape if one.kind == "break"]
        value.append(min(breaks, key=lambda one: abs(one.at_s - trajectory.t_s[0] - 20)).value[0])
    assert value[0] - value[1] == pytest.approx(0.02, rel=0.15)


def test_the_probability_of_a_break_is_its_frequency():
    """Models drawn as the prior says, one in five torn by 3 %: of those said to be torn with 40 %, 40 % are."""
    rng = np.random.default_rng(5)
    sigma, by_scale, tolerated = 0.01, -0.4, 0.003
    torn, said, variance, change = [], [], [], []
    for _ in range(20000):
        is_torn = rng.random() < 0.2
        size = 0.03 * rng.standard_normal() * is_torn
        measured = size + np.hypot(sigma, tolerated) * rng.standard_normal()
        one = ShapeFault(
            kind="break",
            at_s=20.0,
            value=np.array([measured]),
            cov=np.array([[sigma**2 / 1.2]]),
            by_scale=np.array([by_scale]),
        )
        found = judge_breaks([one], 1.2)
        assert found is not None and found.fault is one
        torn.append(is_torn)
        said.append(found.probability)
        variance.append(found.variance)
        change.append((by_scale * size) ** 2)
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.7), (0.7, 1.0)):
        among = (np.array(said) >= low) & (np.array(said) <= high)
        assert np.mean(np.array(torn)[among]) == pytest.approx(np.mean(np.array(said)[among]), abs=0.03)
    assert np.mean(change) == pytest.approx(np.mean(variance), rel=0.05)
    assert judge_breaks([], 1.0) is None


@pytest.mark.parametrize("fault", ["torn", "drift", "stretch"])
def test_a_wrong_shape_is_named_and_the_larger_part_keeps_its_metres(outcomes, fault):
    by_hand = [o for o in outcomes(fault, length_s=40.0, most=1) if o.altered.window.recording.startswith("room")]
    large = [o for o in by_hand if o.altered.size >= 0.03]
    assert len(large) >= 6 and all(o.named and o.verdict == "weak" for o in large)
    assert all(abs(o.error) < Z95 * o.sigma for o in by_hand)


def test_a_torn_model_is_no_part_of_a_joined_one(study, shared_data):
    folder = shared_data / "real_imu"
    window = next(w for w in study.windows(folder, (40.0,), (study.NOISE_M,), most=1) if w.recording == "room3")
    trajectory, imu, truth = study.recorded(folder, window)
    metric = replace(trajectory, cam_in_world=trajectory.cam_in_world * truth)
    sound = FittedPath.of(metric, imu, None, ScaleOptions())
    assert sound.scale[0] == pytest.approx(1.0, abs=0.02)
    torn, _ = study.alter(study.Altered(window=window, fault="torn", size=0.05), metric, imu, 1.0)
    with pytest.raises(NotObservableError, match="scale is not the same throughout"):
        FittedPath.of(torn, imu, None, ScaleOptions())


def test_sound_models_are_not_accused_and_single_wrong_centres_hardly_count(study, outcomes):
    assert not any(o.named for o in outcomes("clean", length_s=40.0, most=1))
    moved = study.summary(outcomes("moved", length_s=20.0, most=1))
    assert moved["named"] >= 5 and moved["given"] == 6 and moved["inside"] >= 5


def test_what_is_undone_is_what_was_done():
    """A path whose steps grew from some instant on, and one that was strained, are what they were."""
    rng = np.random.default_rng(3)
    t_s, path = np.arange(0.0, 40.0, 0.125), np.cumsum(rng.standard_normal((320, 3)), axis=0)
    by_break = ShapeFault(kind="break", at_s=25.0, value=np.array([0.05]), cov=np.eye(1), by_scale=np.zeros(1))
    grown = np.interp(0.5 * (t_s[1:] + t_s[:-1]), [23.0, 27.0], [0.0, 0.05])
    steps = np.diff(path, axis=0) * np.exp(-grown)[:, None]
    torn = path[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    assert np.allclose(by_break.undo(t_s, torn), path)
    earlier = replace(by_break, at_s=10.0)
    assert np.allclose(np.diff(earlier.undo(t_s, path), axis=0)[100:], np.diff(path, axis=0)[100:])
    strain = ShapeFault(kind="stretch", value=0.01 * rng.standard_normal(5), cov=np.eye(5), by_scale=np.zeros(5))
    assert np.trace(strain.strain) == pytest.approx(0, abs=1e-12)
    bent = path @ np.linalg.inv(np.eye(3) + strain.strain)
    assert np.allclose(strain.undo(t_s, bent), path)
