"""Advice follows the finding: one table, the refusals of results, and findings that a run would otherwise end with."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import ImuRecording
from colmap_inertial.diagnose import Finding, Recorded, diagnose, unreadable
from colmap_inertial.messages import all_messages
from colmap_inertial.motion.flow import VisualRotation
from colmap_inertial.report.words import not_checked, outcome_of_model
from scripts.studies.diagnose import LENS, pictures, simulated

ROOT = Path(__file__).parents[2]
REFUSED = {
    "verdict": "refused",
    "metres_per_unit": None,
    "ci95": None,
    "reasons": ["x"],
    "sparse": "colmap/sparse/0",
    "registered_images": 9,
    "points": 99,
}


def test_every_finding_of_the_documentation_has_advice_and_the_other_way_round():
    text = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8").split("## Findings of diagnose")[1]
    told = {code for row in re.findall(r"^\| (`.*?) \|", text, re.M) for code in re.findall(r"`([a-z-]+)`", row)}
    known = all_messages()
    assert {code for code in told if not Fact(code, **known[code].example).advice} == set()
    assert {code for code, of in known.items() if of.text.__module__.endswith(".findings")} <= told


def test_a_finding_has_code_words_numbers_and_advice_of_its_fact():
    fact = Fact("clock-offset", offset_s=2.5, max_offset_s=1.0, clocks=None)
    finding = Finding(fact=fact, severity="error")
    assert (finding.code, finding.evidence, finding.advice) == ("clock-offset", str(fact), fact.advice)
    assert finding.sentence == f"{fact}; {fact.advice} (clock-offset)" == str(finding.reason)
    assert finding.numbers == {"offset_s": 2.5, "max_offset_s": 1.0}
    written = finding.as_json()
    assert written["evidence_details"] == fact.as_json()
    assert {name: written[name] for name in ("code", "severity", "evidence", "advice")} == {
        "code": "clock-offset",
        "severity": "error",
        "evidence": str(fact),
        "advice": fact.advice,
    }


def test_advice_goes_by_the_values_of_what_was_found():
    both, alone = Fact("gyro-mirrored"), Fact("gyro-mirrored", gyro=("-x,y,z", True))
    assert "both sensors" in both.advice
    assert alone.advice.startswith('set axes = "-x,y,z" and mirrored = true under [imu.gyro]')
    assert "a global shutter" in Fact("readout-unknown", why=Fact("readout-without-gyroscope")).advice
    measured = Fact("readout-unknown", readout_s=0.02, readout_sigma_s=0.001, direction="up", pairs=40)
    assert 'readout_s = 0.0200 and readout_direction = "up"' in measured.advice


def test_what_cannot_be_read_is_a_finding_with_the_words_of_its_error():
    told = unreadable(FormatError("imu.csv", Fact.stated("holds no rows"), line=3))
    assert (told.code, told.evidence) == ("unreadable", "imu.csv, line 3: holds no rows")
    assert unreadable(TimingError(Fact.stated("frames.csv has no header"))).code == "untimed"
    fact = Fact("stamps-reversed", path="imu.csv", sensor="gyroscope")
    stamps = TimingError(fact, shown=str(fact))
    assert unreadable(stamps).fact == fact and str(stamps) == str(fact)


def test_a_refusal_repeats_what_was_found_and_never_says_to_film_again_where_the_recording_was_fine():
    mirrored = Fact("gyro-mirrored")
    finding = Finding(fact=mirrored, severity="error").as_json()
    told = outcome_of_model({**REFUSED, "signals": {"alignment": "failed"}, "findings": [finding]})
    assert any("gyro-mirrored" in text and str(mirrored) in text for text in told["summary"])
    assert told["todo"][0].lower().startswith(mirrored.advice.lower())
    assert not any("Film again" in text or "Record the raw" in text for text in told["todo"])
    lively = {"alignment": "done", "acceleration": {"rms_accelerometer_m_s2": 1.4}}
    assert not any("Film again" in text for text in outcome_of_model({**REFUSED, "signals": lively})["todo"])
    still = {"alignment": "done", "acceleration": {"rms_accelerometer_m_s2": 0.05}}
    assert "Film again" in outcome_of_model({**REFUSED, "signals": still})["todo"][0]


def test_what_was_compared_is_not_called_unchecked():
    assert not_checked({"gyroscope", "accelerometer", "pictures far apart"}) == ""
    assert "match" in not_checked({"gyroscope", "accelerometer"})


def hovering(rng: np.random.Generator, *, turns: bool) -> Recorded:
    """A camera that drifts at 0.013 rad/s and turns in its last second alone; or about all axes throughout."""
    t_s = np.arange(0, 12, 1 / 30)
    fine_s = np.arange(-0.5, 12.5, 1 / 400)

    def rate(when_s):
        if turns:
            return 0.3 * np.stack([np.sin(1.3 * when_s), np.sin(2.1 * when_s + 1), np.sin(0.7 * when_s + 2)], axis=1)
        still = np.tile([0.013, -0.005, 0.003], (len(when_s), 1))
        still[:, 1] += 0.4 * np.clip(when_s - 11, 0, None)
        return still

    middle = 0.5 * (t_s[1:] + t_s[:-1])
    turn = rate(middle) / 30 + rng.normal(0, 3e-4, (len(middle), 3))
    imu = ImuRecording(
        gyro_t_s=fine_s,
        gyro_rad_s=rate(fine_s) + rng.normal(0, 0.004, (len(fine_s), 3)),
        accel_t_s=fine_s,
        accel_m_s2=np.array([0, -9.8, 0]) + rng.normal(0, 0.5, (len(fine_s), 3)),
    )
    seen = VisualRotation(
        names=tuple(f"{i}" for i in range(len(t_s))),
        t_s=t_s,
        turn_rad=turn,
        sigma_rad=np.full(len(turn), 3e-4),
        support=np.full(len(turn), 200),
    )
    return Recorded(imu=imu, rotation=seen, max_offset_s=1.0)


def test_a_camera_that_turns_in_one_second_alone_is_stopped_before_mapping():
    told = diagnose(hovering(np.random.default_rng(0), turns=False))
    assert "rotation-too-little" in {finding.code for finding in told.stopping}
    lively = diagnose(hovering(np.random.default_rng(0), turns=True))
    assert "rotation-too-little" not in lively.codes


def test_a_gain_of_the_gyroscope_shows_in_a_video_with_any_intrinsics(subtests):
    for gain in (1.31, 0.7):
        for declared in (True, False):
            with subtests.test(gain=gain, declared=declared):
                base = simulated(3)
                shown = replace(pictures(base, np.random.default_rng(1)), camera=LENS if declared else None)
                assert "gyro-gain" not in diagnose(shown).codes
                wrong = replace(shown, imu=replace(base.imu, gyro_rad_s=gain * base.imu.gyro_rad_s))
                told = diagnose(wrong)
                assert "gyro-gain" in told.codes
                assert "focal-length" not in told.codes
