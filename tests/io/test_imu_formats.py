"""IMU formats of other installed packages: found through their entry points, in every process."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.io import imu_formats as formats
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.imu import read_imu
from tests.helpers.asl_imu import handheld

MODULE = """
from pathlib import Path

import numpy as np

from colmap_inertial.io.imu_formats import ImuFormat
from colmap_inertial.core.types import ImuRecording


def read(path: Path, units) -> ImuRecording:
    rows = np.loadtxt(path)
    return ImuRecording(
        gyro_t_s=rows[:, 0], gyro_rad_s=rows[:, 1:4], accel_t_s=rows[:, 0], accel_m_s2=rows[:, 4:7], device="mine"
    )


def is_mine(path: Path) -> bool:
    return path.suffix == ".mylog"


FORMAT = ImuFormat(name="mine", layout="a log of mine (.mylog)", accepts=is_mine, read=read)
FILM = ImuFormat(name="film", layout="", accepts=is_mine, read=read, video=())
TAKEN = ImuFormat(name="csv", layout="", accepts=lambda path: True, read=read)


def fails(path: Path, *_):
    raise RuntimeError("out of coffee")


UNSURE = ImuFormat(name="unsure", layout="", accepts=fails, read=read)
FAILING = ImuFormat(name="failing", layout="", accepts=lambda path: path.suffix == ".bad", read=fails, frames=fails)
EMPTY = ImuFormat(name="empty", layout="", accepts=is_mine, read=lambda path, units: None)
"""


def install(folder: Path, *entries: str, package: str = "my-imu-logs", module: str = MODULE) -> Path:
    """What pip leaves of a package in a folder of ``sys.path``."""
    name = package.replace("-", "_")
    (folder / f"{name}.py").write_text(module)
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = "".join(f"{name}{i} = {entry}\n" for i, entry in enumerate(entries))
    (info / "entry_points.txt").write_text(f"[{formats.ENTRY_POINTS}]\n{lines}")
    return folder


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A folder of installed packages; whatever this process found before is forgotten."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    formats._load_other_packages.cache_clear()
    yield folder
    formats._load_other_packages.cache_clear()
    sys.modules.pop("my_imu_logs", None)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    _, gyro, accel = handheld()
    np.savetxt(tmp_path / "a.mylog", np.hstack([np.arange(400)[:, None] / 200, gyro, accel]))
    return tmp_path / "a.mylog"


def run(site: Path, *command: object) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, *map(str, command)], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )


def test_an_installed_package_is_seen_by_every_process(site: Path, log: Path) -> None:
    install(site, "my_imu_logs:FORMAT")
    code = (
        "import sys; from pathlib import Path; from colmap_inertial import read_imu\n"
        "print(read_imu(Path(sys.argv[1])).device)"
    )
    done = run(site, "-c", code, log)
    assert (done.stdout, done.stderr) == ("mine\n", "")
    (log.parent / "capture.toml").write_text(f'[imu]\npath = "{log.name}"\nformat = "mine"\n')
    for path in (log, log.parent):
        done = run(site, "-m", "colmap_inertial", "diagnose", path)
        assert (done.returncode, done.stderr) == (0, "")
        assert "checked: gyroscope, accelerometer" in " ".join(done.stdout.split())
    without = run(log.parent, "-m", "colmap_inertial", "diagnose", log)
    assert without.returncode == 2
    assert "not an inertial recording" in without.stderr


def test_other_packages_go_first_and_a_recording_may_describe_itself(site: Path, log: Path) -> None:
    install(site, "my_imu_logs:FORMAT", "my_imu_logs:FILM")
    assert [one.name for one in formats.imu_formats()[:2]] == ["mine", "film"]
    assert formats.imu_formats()[2:] == formats._OWN
    assert read_imu(log, format="mine").device == "mine"
    capture = load_capture(log)
    assert (capture.imu.format, capture.frames.file) == ("film", log)


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ("my_imu_logs:ABSENT", "ABSENT"),
        ("my_imu_logs.absent:FORMAT", "ModuleNotFoundError"),
        ("my_imu_logs:read", "my_imu_logs:read is no ImuFormat"),
        ("my_imu_logs:TAKEN", 'the name "csv" is taken'),
    ],
)
def test_a_package_that_provides_no_format_is_named_and_left_out(site: Path, log: Path, caplog, entry, reason) -> None:
    install(site, entry, "my_imu_logs:FORMAT")
    assert [one.name for one in formats.imu_formats()][:2] == ["mine", "euroc"]
    (record,) = caplog.records
    assert "of the package my-imu-logs is left out" in record.message
    assert reason in record.message


def test_a_package_that_cannot_be_imported_is_named_and_others_are_used(site: Path, log: Path, caplog) -> None:
    install(site, "my_imu_logs:FORMAT", module="raise SystemError('broken')\n")
    with pytest.raises(FormatError) as refused:
        read_imu(log)
    assert refused.value.code == "no-known-recording"
    assert "my-imu-logs is left out: SystemError: broken" in caplog.text
    install(site, "other_logs:FORMAT", package="other-logs")
    done = run(site, "-m", "colmap_inertial", "diagnose", log)
    assert done.returncode == 0
    assert "of the package my-imu-logs is left out" in done.stderr
    assert "Traceback" not in done.stderr


def test_what_a_format_of_another_package_does_wrong_is_an_error_that_names_it(site: Path, log: Path, caplog) -> None:
    install(site, *(f"my_imu_logs:{name}" for name in ("UNSURE", "FAILING", "EMPTY", "FORMAT")))
    bad = log.with_suffix(".bad")
    bad.write_text("")
    for name, reads in (("failing", bad), ("auto", bad)):
        with pytest.raises(FormatError, match="failing of the package my-imu-logs failed: RuntimeError: out of coffee"):
            read_imu(reads, format=name)
    assert "unsure of the package my-imu-logs cannot tell whether it is one" in caplog.text
    with pytest.raises(FormatError, match="my-imu-logs failed: RuntimeError"):
        formats.find_imu_format(bad).frames(bad)
    with pytest.raises(FormatError, match="read gives a NoneType"):
        read_imu(log)
    done = run(site, "-m", "colmap_inertial", "diagnose", bad)
    assert done.returncode in (1, 2)
    assert "my-imu-logs failed" in " ".join((done.stdout + done.stderr).split())
    assert "Traceback" not in done.stderr


def test_errors_of_ours_pass(site: Path, log: Path) -> None:
    module = MODULE.replace(
        "raise RuntimeError", "from colmap_inertial.core.errors import TimingError; raise TimingError"
    )
    install(site, "my_imu_logs:FAILING", module=module)
    with pytest.raises(TimingError, match=r"^out of coffee"):
        read_imu(log, format="failing")
