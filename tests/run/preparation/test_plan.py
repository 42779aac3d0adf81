"""The imaging plan: rotation within an exposure, and surveys."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.run.preparation import plan
from colmap_inertial.run.preparation.plan import _most_turned_rad
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording


@pytest.fixture(scope="module")
def recording():
    return simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=15.0)), seed=3)


def test_what_a_gyroscope_felt_just_before_an_uncertain_exposure_counts(recording):
    epoch_ns, prior = recording.trajectory.epoch_ns, replace(recording.truth.calibration, cov=1e-6 * np.eye(12))
    stamps_s = CameraTimedImu.from_recording(recording.imu, prior, epoch_ns).gyro_t_s
    rate = np.zeros_like(recording.imu.gyro_rad_s)
    at = len(stamps_s) // 2
    rate[at, 2] = 2.0
    imu = replace(recording.imu, gyro_rad_s=rate)
    uncertain_s = 3 * prior.clock_sigma_s
    step_s = float(np.median(np.diff(stamps_s)))
    for after_s, felt in ((uncertain_s + 4 * step_s, 0.0), (uncertain_s + 0.5 * step_s, 0.02)):
        timing = SimpleNamespace(t_s=stamps_s[[at]] + after_s, readout_s=0.0, epoch_ns=epoch_ns)
        case = SimpleNamespace(timing=timing, prior=prior, imu=imu)
        assert _most_turned_rad(case, np.array([0.01])) == pytest.approx(felt)
    # and after its last line was exposed, as late as the readout and the clocks let it be
    for readout_s, longest_s in ((0.02, 0.02), (None, plan._LIMITS.longest_readout_s)):
        end_s = longest_s + 0.01 + uncertain_s
        for before_s, felt in ((end_s + 4 * step_s, 0.0), (end_s - 0.5 * step_s, 0.02)):
            timing = SimpleNamespace(t_s=stamps_s[[at]] - before_s, readout_s=readout_s, epoch_ns=epoch_ns)
            case = SimpleNamespace(timing=timing, prior=prior, imu=imu)
            assert _most_turned_rad(case, np.array([0.01])) == pytest.approx(felt)


@pytest.mark.parametrize(("sizes", "models"), [([2, 2, 3], 2), ([2, 3, 3, 4], 3), ([3, 2], 2)])
def test_frames_are_surveyed_again_only_while_more_of_them_register(monkeypatch, sizes, models):
    made = iter(sizes)
    asked = []

    def model_of(names, treated):
        asked.append(treated)
        return tuple(f"{i}.jpg" for i in range(next(made)))

    segment = [f"{i}.jpg" for i in range(9)]
    monkeypatch.setattr(plan, "_LIMITS", replace(plan._LIMITS, surveys=5))
    monkeypatch.setattr(plan._Surveyed, "of", lambda registered, view: SimpleNamespace(registered=registered))
    for name, answer in {
        "survey_parts": [segment],
        "_decisions": None,
        "_blurred": True,
        "_select_blurred": segment,
        "_group_by_segment": {0: set(segment)},
        "_merge_parallaxes": {"0.jpg": 1.0},
        "_decided": SimpleNamespace(deblur="yes"),
    }.items():
        monkeypatch.setattr(plan, name, lambda *_, answer=answer: answer)
    treated = plan._deblurring(None, SimpleNamespace(timing=None), None, model_of, lambda _: [], None)
    # the first model is of frames as filmed
    assert asked == [None, *[treated] * (models - 1)]
