"""The check beforehand is the same for every command: what `diagnose` finds stops `reconstruct` and `scale`, too."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_inertial import ReconstructOptions, reconstruct
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ScaleOptions
from colmap_inertial.core.types import CameraTrajectory, FrameTiming, ImuRecording
from colmap_inertial.diagnose import Diagnosis, Recorded, diagnose
from colmap_inertial.run.commands.diagnose import collect, diagnose_source
from colmap_inertial.run.commands.scale import ScaleSource, scale_source
from scripts.studies.mistakes import DESK, stamps, toml, values, write_poses


class _Stopped(Exception):
    pass


FAULTS: dict[str, Callable[[Path, np.random.Generator], None]] = {
    "none": lambda scene, rng: None,
    "gyro-mirrored": values("gyro.csv", change=lambda rate, _: rate * [-1, 1, 1]),
    "clock-rate": stamps("gyro.csv", "accel.csv", change=lambda t_s, _: 1.03 * t_s),
    "clock-offset": toml("[timing]", "[timing]\nshared_clock = true"),
    "gyro-gain": values("gyro.csv", change=lambda rate, _: 1.3 * rate),
    "imu-does-not-fit": values("gyro.csv", "accel.csv", change=lambda reading, _: reading[::-1]),
}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    shutil.copytree(DESK, folder)
    write_poses(folder)
    return folder


# the others are found in the same poses below, and by the study of mistakes
@pytest.mark.parametrize("code", ["none", "gyro-mirrored", "clock-offset"])
def test_a_reconstruction_finds_what_diagnose_finds_and_stops_before_features(code, scene, tmp_path):
    FAULTS[code](scene, np.random.default_rng(0))
    alone = diagnose_source(ScaleSource(source=scene))
    assert ({code} - {"none"}) == {finding.code for finding in alone.stopping}
    heard: list[Diagnosis] = []

    def listen(found: Diagnosis) -> None:
        heard.append(found)
        if not found.stopping:
            raise _Stopped

    with pytest.raises(NotObservableError if alone.stopping else _Stopped) as stopped:
        reconstruct(scene, tmp_path / "out", ReconstructOptions(), findings=listen)
    assert heard[0].as_json() == alone.as_json()
    assert not (tmp_path / "out/colmap/database.db").exists()
    if alone.stopping:
        assert alone.stopping[0].sentence in str(stopped.value)


@pytest.mark.parametrize("code", FAULTS)
def test_scale_is_refused_for_every_error_that_diagnose_finds_in_the_same_poses(code, scene):
    FAULTS[code](scene, np.random.default_rng(0))
    source = ScaleSource(source=scene / "poses.txt", imu=scene)
    stopping = diagnose_source(source).stopping
    estimate = scale_source(source, ScaleOptions())
    if code == "none":
        assert not stopping
        assert estimate.verdict != "refused"
    else:
        assert code in {finding.code for finding in stopping}
        found = tuple(Fact("found-beforehand", finding=finding.fact) for finding in stopping)
        assert estimate.reasons == (*found, Fact("force-goes-on"))
        assert [str(reason) for reason in estimate.reasons[:-1]] == [finding.sentence for finding in stopping]


def test_an_image_that_cannot_be_read_is_bad_input_and_forcing_does_not_go_on(scene, tmp_path):
    picture = sorted((scene / "frames").iterdir())[20]
    picture.write_bytes(picture.read_bytes()[:200])
    assert any(picture.name in finding.evidence for finding in diagnose_source(ScaleSource(source=scene)).stopping)
    with pytest.raises(FormatError, match=picture.name):
        reconstruct(scene, tmp_path / "out", ReconstructOptions(force=True))


def test_a_damaged_recording_of_poses_is_a_finding_for_diagnose_and_bad_input_for_scale(scene):
    gyro = scene / "gyro.csv"
    gyro.write_text(gyro.read_text() + "1,2\n")
    source = ScaleSource(source=scene / "poses.txt", imu=scene)
    recorded = collect(source, lambda *_: None)
    assert isinstance(recorded.trajectory, CameraTrajectory)
    assert [str(error) for error in recorded.refused] == [f.evidence for f in diagnose(recorded).stopping]
    with pytest.raises(InertialError, match=r"gyro\.csv"):
        scale_source(source, ScaleOptions())


def test_a_damaged_model_is_a_finding_for_diagnose_and_bad_input_for_scale(scene, tmp_path):
    model = tmp_path / "model"
    model.mkdir()
    pycolmap.Reconstruction().write(str(model))
    (model / "images.bin").write_bytes(b"\x09")
    source = ScaleSource(source=model, imu=scene)
    recorded = collect(source, lambda *_: None)
    assert recorded.imu is not None and recorded.trajectory is None
    assert any("images.bin" in finding.evidence for finding in diagnose(recorded).stopping)
    with pytest.raises(FormatError, match=r"images\.bin"):
        scale_source(source, ScaleOptions())


def test_an_imu_that_ran_along_with_the_poses_is_long_enough_whatever_other_images_there_are():
    t_s = np.arange(0, 4, 0.1)
    still = np.zeros((len(t_s), 3))
    poses = CameraTrajectory(
        names=tuple(map(str, range(len(t_s)))),
        t_s=t_s,
        cam_from_world_xyzw=np.tile([0, 0, 0, 1.0], (len(t_s), 1)),
        cam_in_world=still,
    )
    fine_s = np.arange(-1, 5, 0.01)
    up = np.tile([0, 0, 9.8], (len(fine_s), 1))
    imu = ImuRecording(gyro_t_s=fine_s, gyro_rad_s=0 * up, accel_t_s=fine_s, accel_m_s2=up)
    every_s = np.arange(0, 40, 0.1)
    timing = FrameTiming(names=tuple(map(str, range(len(every_s)))), t_s=every_s, exposure_s=None, readout_s=None)
    assert "imu-too-short" in diagnose(Recorded(imu=imu, timing=timing)).codes
    assert "imu-too-short" not in diagnose(Recorded(imu=imu, timing=timing, trajectory=poses)).codes
