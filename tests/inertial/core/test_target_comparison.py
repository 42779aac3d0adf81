"""What results with targets say of a device's accelerometer, and what becomes of a scale's interval."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.errors import FormatError, NotObservableError, OutputError
from colmap_inertial.inertial.core.target_comparison import TargetComparison, calibrate_by_targets
from colmap_inertial.inertial.scale import estimate_scale
from colmap_inertial.io.calibration import read_imu_calibration, write_imu_calibration
from colmap_inertial.run.commands.calibrate_imu import _read_comparison, calibrate_from_results, remember
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording

by_targets = partial(calibrate_by_targets, gravity_m_s2=9.81)
ACCEL, OTHER, TARGET = 0.006, 0.0025, 0.001


def compared(*errors: float, target: str = "board") -> list[TargetComparison]:
    return [
        TargetComparison(
            error_log=error, accel_sigma_log=ACCEL, sigma_log=OTHER, target=target, target_sigma_log=TARGET
        )
        for error in errors
    ]


def factor(*errors: float) -> float:
    found = by_targets(compared(*errors)).accel_factor
    assert found is not None
    return found


def test_the_next_recording_errs_as_the_factor_says():
    """Devices drawn at random: what is common to a device's recordings, what is each one's, and the board's error."""
    rng = np.random.default_rng(4)
    z, factors = [], []
    for _ in range(1500):
        share, count = rng.uniform(), int(rng.integers(1, 7))
        own = math.sqrt(1 - share) * rng.normal(size=count + 1)
        part = ACCEL * (math.sqrt(share) * rng.normal() + own)
        errors = part[:-1] + OTHER * rng.normal(size=count) + TARGET * rng.normal()
        factors.append(factor(*errors))
        z.append(part[-1] / (ACCEL * factors[-1]))
    narrow = np.array(factors) < np.median(factors)
    for some in (narrow, ~narrow):
        assert np.mean(np.square(z)[some]) == pytest.approx(1, abs=0.17)
        assert 0.93 < np.mean(np.abs(z)[some] < 1.96) < 0.97


def test_agreement_narrows_scatter_does_not_and_a_bad_device_is_wider():
    assert factor(*[0.001] * 8) < 0.5 < factor(*[0.001] * 2) < 0.85
    assert 0.8 < factor(0.006, -0.005, 0.0055, -0.006) < 1.1
    assert factor(0.03, 0.031, 0.029) > 3 and factor(0.03, -0.002) > 1.5
    # errors of one board do not average out
    of_one, of_many = (
        by_targets([replace(compared(0.0, target=name)[0], target_sigma_log=0.004) for name in names])
        for names in (["board"] * 30, map(str, range(30)))
    )
    assert of_many.accel_factor < 0.7 * of_one.accel_factor
    with pytest.raises(NotObservableError, match="no result was compared"):
        by_targets([])


def test_a_scale_keeps_its_value_and_its_interval_the_rest():
    recording = simulate_recording(RecordingOptions(motion=MotionOptions(duration_s=20.0)), seed=3)
    before = estimate_scale(recording.trajectory, recording.imu)
    calibration = by_targets(compared(*[0.0] * 8))
    after = estimate_scale(recording.trajectory, recording.imu, imu_calibration=calibration)
    assert after.metres_per_unit == pytest.approx(before.metres_per_unit, rel=1e-9)
    assert before.parts is not None and after.parts is not None and calibration.accel_factor is not None
    assert after.parts["accel_gain"] == pytest.approx(calibration.accel_factor * before.parts["accel_gain"], rel=1e-6)
    for name, part in before.parts.items():
        if name != "accel_gain":
            assert after.parts[name] == pytest.approx(part, rel=1e-6, abs=1e-12), name
    assert after.sigma_log == pytest.approx(math.sqrt(sum(part**2 for part in after.parts.values())), rel=1e-9)
    assert after.as_json()["imu_calibration"]["compared"] == 8


# --- results and the command -----------------------------------------------------------------------------------------


def result(error_pct: float = 0.1, *, capture: str = "a", **changes) -> dict:
    validation = {
        "target": "checkerboard:8x6:0.04+-0.00004",
        "within_tolerance": True,
        "doubts": [],
        "scale_error_pct": error_pct,
        "ci95_pct": [error_pct - 0.3, error_pct + 0.3],
        "reasons": ["two images only"],
    }
    model = {
        "index": 0,
        "registered_images": 40,
        "verdict": "trusted",
        "sigma_log": 0.0065,
        "parts": {"accel_gain": 0.006, "camera_path": 0.0025},
        "imu_calibration": None,
        "validation": validation | changes.pop("validation", {}),
    }
    return {"capture": f"/home/user/{capture}/capture.toml", "models": [model | changes]}


def earlier() -> dict:
    """A result of a version that did not tell doubts from other reasons."""
    content = result(validation={"within_tolerance": False})
    del content["models"][0]["validation"]["doubts"]
    return content


def run(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def write_result(folder: Path, content: dict) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "result.json").write_text(json.dumps(content))
    return folder


def test_of_a_result_s_uncertainties_each_counts_once():
    """The check knows its distances to a tenth of a per cent of the target's own; the scale has a part of the gain."""
    (model,) = result(2.0)["models"]
    small = {**model, "registered_images": 12, "sigma_log": 0.5}
    refused = {**model, "registered_images": 90, "verdict": "refused"}
    found = _read_comparison(Path("result.json"), [small, refused, model])
    assert found.error_log == pytest.approx(math.log(1.02)) and found.accel_sigma_log == 0.006
    assert found.target == "checkerboard:8x6:0.04+-0.00004" and found.target_sigma_log == pytest.approx(0.001)
    # the check's interval holds the target's share, the scale's the gain's; both are told apart
    check = (math.log(1.023) - math.log(1.017)) / (2 * 1.959964)
    others = math.sqrt(check**2 - 0.001**2 + 0.0065**2 - 0.006**2)
    assert found.sigma_log == pytest.approx(others, rel=1e-4)
    sure = {**model, "sigma_log": 0.005, "validation": {**model["validation"], "ci95_pct": [1.99, 2.01]}}
    assert _read_comparison(Path("result.json"), [sure]).sigma_log == 0


def test_the_command_writes_and_remembers_what_results_show(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    folders = [write_result(tmp_path / name, result(pct, capture=name)) for name, pct in {"a": 0.1, "b": -0.2}.items()]
    out = tmp_path / "phone_imu.json"
    words = ["calibrate-imu", *map(str, folders), "--out", str(out), "--remember", "My phone"]
    assert run(words) == 0
    shown = capsys.readouterr().out
    assert "2 results with targets" in shown and "Remembered" in shown
    found = read_imu_calibration(out)
    target, of_check = 0.001, (math.log1p(0.004) - math.log1p(-0.002)) / (2 * 1.959964)
    expected = [
        TargetComparison(
            error_log=math.log1p(0.01 * pct),
            accel_sigma_log=0.006,
            sigma_log=math.sqrt(0.0065**2 - 0.006**2 + (sides[1] - sides[0]) ** 2 / (2 * 1.959964) ** 2 - target**2),
            target="one",
            target_sigma_log=target,
        )
        for pct in (0.1, -0.2)
        for sides in [(math.log1p(0.01 * (pct - 0.3)), math.log1p(0.01 * (pct + 0.3)))]
    ]
    assert of_check > target
    assert found.accel_factor == pytest.approx(by_targets(expected).accel_factor, rel=1e-6)
    assert (found.device, found.compared, found.attitudes) == ("My phone", 2, 0)
    assert f"{found.accel_factor:.2f}" in shown
    # far beyond any tolerance, and still what the target says
    write_result(tmp_path / "a", result(3.0, capture="a"))
    assert run(words) == 0 and read_imu_calibration(out).accel_factor > 1.5
    capsys.readouterr()
    assert run([*words[:2], "--out", str(out), "--json", "-"]) == 0  # one result will do
    assert json.loads(capsys.readouterr().out)["compared"] == 1


def test_a_result_that_shows_nothing_is_refused_by_name(subtests, tmp_path_factory):
    for i, (content, said) in enumerate(
        (
            (result(validation={"scale_error_pct": None}), "no scale with a measured target"),
            (result(verdict="refused"), "no scale with a measured target"),
            (result(imu_calibration={"attitudes": 12}), "already used a calibration of the IMU"),
            (result(validation={"doubts": ["too few"]}), "the target may differ from its description: too few"),
            (earlier(), "the target may differ from its description: two images only"),
            (result(validation={"target": "checkerboard:8x6:0.04"}), r"is not stated; measure it, and add \+-"),
            (result(parts=None), "not that of the joint method"),
            ({"capture": "x"}, "is not a result"),
            (result(capture="b"), "like another of these results"),
        )
    ):
        with subtests.test(i=i, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            sound = write_result(tmp_path / "sound", result(capture="b"))
            with pytest.raises(FormatError, match=said) as caught:
                calibrate_from_results([sound, write_result(tmp_path / "other", content)], tmp_path / "out.json")
            assert str(tmp_path / "other" / "result.json") in str(caught.value)
            assert not (tmp_path / "out.json").exists()


def test_a_calibration_by_rests_is_not_replaced_by_targets_and_a_place_is_for_rests(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "config"))
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    by_target = by_targets(compared(0.001))
    for name, calibration in (("rests", replace(by_target, attitudes=12, accel_factor=None)), ("targets", by_target)):
        write_imu_calibration(tmp_path / f"{name}.json", calibration)
    kept = remember("My phone", tmp_path / "targets.json")
    assert remember("My phone", tmp_path / "rests.json") == kept
    with pytest.raises(OutputError, match="from rests, which is better than one from targets: remove it first"):
        remember("My phone", tmp_path / "targets.json")
    assert read_imu_calibration(kept).attitudes == 12
    out = ["--out", str(tmp_path / "out.json")]
    for words, said in ((["a", "b", "--latitude-deg", "47"], "with results"), ([], "name the recording")):
        assert run(["calibrate-imu", *words, *out]) == 2
        assert said in capsys.readouterr().err
