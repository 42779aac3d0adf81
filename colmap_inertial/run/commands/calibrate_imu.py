"""Calibrations of IMUs: made from recordings of rests, and kept by the command line for a user's devices."""

from __future__ import annotations

import hashlib
import math
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_inertial.core.errors import FormatError, InertialError, OutputError, OutputExistsError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import GravityOptions
from colmap_inertial.core.quantiles import Z95
from colmap_inertial.core.types import ImuCalibration
from colmap_inertial.inertial.core.target_comparison import TargetComparison, calibrate_by_targets
from colmap_inertial.inertial.scale import check_units, strength_of_gravity
from colmap_inertial.inertial.static_calibration import RestCalibration, calibrate_imu
from colmap_inertial.io.calibration import (
    CAMERA_IMU,
    IMU,
    calibration_kind,
    read_imu_calibration,
    write_imu_calibration,
)
from colmap_inertial.io.capture import Capture, load_capture
from colmap_inertial.io.files import read_json, read_text, reading, write_text
from colmap_inertial.io.imu import read_unchecked_capture_imu, read_unchecked_imu
from colmap_inertial.io.plausible import check_alive
from colmap_inertial.report import require_plotly
from colmap_inertial.report.imu_calibration import calibration_page
from colmap_inertial.run.commands.paths import check_output
from colmap_inertial.validate import parse_target

#: A camera-IMU rotation that is known better than this was stated by the capture.
_STATED_RAD = 1.0
_LONGEST = 60


@dataclass(frozen=True, kw_only=True)
class Remembered:
    """Calibration files that are kept for a device.

    Attributes
    ----------
    device
        Its name; empty where unknown.
    files
        Path and kind of each.
    """

    device: str = ""
    files: tuple[tuple[Path, str], ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths alone."""
        return tuple(path for path, _ in self.files)


def configuration_folder() -> Path:
    """The system's folder for a user's configuration of this program."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming")
    elif sys.platform == "darwin":
        base = home / "Library" / "Application Support"
    else:
        stated = os.environ.get("XDG_CONFIG_HOME", "")
        base = Path(stated) if os.path.isabs(stated) else home / ".config"
    return base / "colmap-inertial"


def remember(device: str, calibration: Path) -> Path:
    """Keep a calibration file under the name of its device, in place of an earlier one of the same kind.

    Returns
    -------
    Where it is kept.

    Raises
    ------
    OutputError
        Where it cannot be written.
    """
    folder = _folder(device)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            Fact("folder-not-created", folder=str(folder), detail=str(error.strerror or error))
        ) from error
    kind = calibration_kind(calibration)
    target = folder / f"{kind}.json"
    by_targets = kind == IMU and read_imu_calibration(calibration).attitudes == 0
    if by_targets and target.is_file() and read_imu_calibration(target).attitudes > 0:
        raise OutputError(Fact("calibrated-by-rests", path=str(target)))
    write_text(target, read_text(calibration))
    return target


def read_remembered(source: Path, given: tuple[Path, ...], *, device: str | None = None) -> Remembered:
    """Read the stored calibrations of the device of a recording, of the kinds that were not given.

    Parameters
    ----------
    source
        A capture, or an IMU recording.
    given
        Calibration files that go before it. What a capture.toml says goes before it, too.
    device
        Name of the device; without it, what the recording says.
    """
    if not (configuration_folder() / "devices").is_dir():
        return Remembered()
    kinds = {calibration_kind(path) for path in given}
    try:
        capture = _capture_of(source)
        if device is None:
            imu = read_unchecked_imu(source) if capture is None else read_unchecked_capture_imu(capture)
            device = imu.device
    except InertialError:
        return Remembered()  # whoever reads it next says what is wrong
    if capture is not None and capture.imu_calibration is not None:
        kinds.add(IMU)
    if capture is not None and capture.calibration.rotation_sigma_rad < _STATED_RAD:
        kinds.add(CAMERA_IMU)
    if not device:
        return Remembered()
    files = ((_folder(device) / f"{kind}.json", kind) for kind in (CAMERA_IMU, IMU) if kind not in kinds)
    return Remembered(device=device, files=tuple((path, kind) for path, kind in files if path.is_file()))


def calibrate_from_results(folders: Sequence[Path], out: Path, *, device: str = "") -> ImuCalibration:
    """Estimate what a device's accelerometer adds to a scale, from results of it that have a target; write it.

    Parameters
    ----------
    folders
        Output folders of ``reconstruct``, each of another recording.
    out
        The calibration's JSON file.
    device
        Name of the device.

    Raises
    ------
    FormatError
        For a folder without a result, without a measured target, with a target whose size nobody knows how well, or
        with a scale that an earlier calibration of the IMU went into; for two of one recording.
    """
    check_output(out, folders)
    gravity_m_s2, _ = strength_of_gravity(GravityOptions())
    comparisons: dict[str, TargetComparison] = {}
    for folder in folders:
        path = folder / "result.json"
        with reading(path, Fact("no-result-of-reconstruct")):
            content = read_json(path)
            capture, comparison = str(content["capture"]), _read_comparison(path, content["models"])
        if capture in comparisons:
            raise FormatError(path, Fact("result-of-same-capture", capture=str(capture)))
        comparisons[capture] = comparison
    calibration = calibrate_by_targets(list(comparisons.values()), gravity_m_s2=gravity_m_s2, device=device)
    write_imu_calibration(out, calibration)
    return calibration


def _read_comparison(path: Path, models: Sequence[Mapping[str, Any]]) -> TargetComparison:
    """The largest model of a result beside its target."""
    measured = [
        model
        for model in models
        if (model.get("validation") or {}).get("scale_error_pct") is not None and model["verdict"] != "refused"
    ]
    if not measured:
        raise FormatError(path, Fact("result-without-target"))
    model = max(measured, key=lambda one: int(one["registered_images"]))
    check = model["validation"]
    if model["imu_calibration"] is not None:
        raise FormatError(path, Fact("result-with-calibration"))
    if doubts := check.get("doubts", () if check["within_tolerance"] else check["reasons"]):  # earlier versions
        raise FormatError(path, Fact("target-doubtful", doubts=doubts))
    target = parse_target(check["target"])
    if target.sigma_m is None:
        raise FormatError(path, Fact("target-size-unstated", target=target.spec))
    low, high = (math.log1p(0.01 * float(pct)) for pct in check["ci95_pct"])
    target_sigma = target.sigma_m / target.length_m
    of_check = max(0.0, ((high - low) / (2 * Z95)) ** 2 - target_sigma**2)
    if "accel_gain" not in (model["parts"] or {}):
        raise FormatError(path, Fact("scale-of-another-method"))
    accel = float(model["parts"]["accel_gain"])
    return TargetComparison(
        error_log=math.log1p(0.01 * float(check["scale_error_pct"])),
        accel_sigma_log=accel,
        sigma_log=math.sqrt(of_check + max(0.0, float(model["sigma_log"]) ** 2 - accel**2)),
        target=target.spec,
        target_sigma_log=target_sigma,
    )


def _capture_of(source: Path) -> Capture | None:
    try:
        return load_capture(source)
    except FormatError:
        return None


def _folder(device: str) -> Path:
    """A device's folder: its name as far as a file may have it, and a mark that tells like ones apart."""
    name = " ".join(device.split())
    if not name:
        raise OutputError(Fact("device-without-name"))
    readable = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:_LONGEST]
    mark = hashlib.sha256(name.lower().encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return configuration_folder() / "devices" / f"{readable}-{mark}".lstrip("-")


def calibrate_source(
    recording: Path, out: Path, gravity: GravityOptions | None = None, *, device: str | None = None
) -> RestCalibration:
    """Calibrate an IMU by a recording of rests; write the calibration, and a page with what is left over beside it.

    Parameters
    ----------
    recording
        What ``read_imu`` accepts.
    out
        The calibration's JSON file; the page has its name, ending in .html.
    gravity
        Where it was made.
    device
        What was calibrated; without it, what the recording says.

    Raises
    ------
    NotObservableError
        Where the device lay in too few attitudes, or in too similar ones.
    FormatError
        Where the recording cannot be read, or is no IMU's.
    """
    require_plotly()
    check_output(out, [recording])
    page = out.with_suffix(".html")
    if page == out:
        raise OutputError(Fact("calibration-is-json", out=str(out)))
    if page.exists() and not out.exists():
        raise OutputExistsError(Fact("calibration-page-exists", page=str(page)))
    imu = read_unchecked_imu(recording)
    if imu.has_accel:
        check_alive(imu.gyro_rad_s, "gyro", imu.source.path)
        check_alive(imu.accel_m_s2, "accel", imu.source.path_of("accel"))
        problems = check_units(imu)
        if problems:
            raise FormatError(imu.source.path, Fact("found-together", found=problems))
    gravity_m_s2, sigma = strength_of_gravity(gravity or GravityOptions())
    calibration = calibrate_imu(imu, gravity_m_s2=gravity_m_s2, gravity_sigma_m_s2=sigma, device=device)
    write_imu_calibration(out, calibration.calibration)
    write_text(page, calibration_page(calibration, source=str(recording.resolve())))
    return calibration
