"""``calibrate-imu``: from a recording of rests to the calibration's file and page."""

from __future__ import annotations

from pathlib import Path

from colmap_inertial.checks.report import require_plotly
from colmap_inertial.checks.report.imu_calibration import calibration_page
from colmap_inertial.core.errors import FormatError, OutputError, OutputExistsError
from colmap_inertial.core.options import GravityOptions
from colmap_inertial.inertial.scale import check_units, strength_of_gravity
from colmap_inertial.inertial.static_calibration import RestCalibration, calibrate_imu
from colmap_inertial.io.calibration import write_imu_calibration
from colmap_inertial.io.files import write_text
from colmap_inertial.io.imu import read_raw_imu
from colmap_inertial.io.plausible import check_alive
from colmap_inertial.reconstruction.drivers.sources import check_output


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
        raise OutputError(f"{out}: the calibration is a JSON file; name it so, as the page beside it ends in .html")
    if page.exists() and not out.exists():
        raise OutputExistsError(f"{page} exists, where the calibration's page goes; choose another name or remove it")
    raw = read_raw_imu(recording)
    imu = raw.imu
    if imu.has_accel:
        check_alive(imu.gyro_rad_s, "gyro", raw.path)
        check_alive(imu.accel_m_s2, "accel", raw.accel_path or raw.path)
        problems = check_units(imu)
        if problems:
            raise FormatError(raw.path, "; ".join(problems))
    gravity_m_s2, sigma = strength_of_gravity(gravity or GravityOptions())
    found = calibrate_imu(imu, gravity_m_s2=gravity_m_s2, gravity_sigma_m_s2=sigma, device=device)
    write_imu_calibration(out, found.calibration)
    write_text(page, calibration_page(found, source=str(recording.resolve())))
    return found
