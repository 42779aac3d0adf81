"""Coverage and accuracy of ``calibrate-imu`` on simulated phones and an Xsens.

Prints four tables: simulated phones in twelve attitudes (coverage of the 95 % intervals by kind of parameter, errors),
with slowly changing biases and without; phones in six to eight attitudes; and, where ``--xsens`` names the table, real
rests of an Xsens MTi in raw counts (Tedaldi, Pretto, Menegatti, ICRA 2014), read by its nominal zeros and factors.

    python -m scripts.studies.calibrate_imu --runs 500 --xsens ../shared/data/imu_rest/xsens.csv.xz
"""

from __future__ import annotations

import argparse
import dataclasses
import lzma
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.types import IMU_CAL, ImuRecording
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.static_calibration import RestCalibration, calibrate_imu
from colmap_inertial.tools.simulate import RestOptions, SimulatedRests, simulate_rests

DIAGONAL = np.array([0, 4, 8])
BESIDE = np.array([1, 2, 3, 5, 6, 7])
LOWER = np.array([3, 6, 7])
#: Kinds of parameters: where they stand in the covariance.
KINDS = {
    "accel gain": DIAGONAL,
    "accel misalignment": LOWER,
    "accel bias": np.arange(9, 12),
    "gyro gain": 12 + DIAGONAL,
    "gyro misalignment": 12 + BESIDE,
    "gyro bias": np.arange(21, 24),
}
UNITS = {"gain": (100, "%"), "misalignment": (180 / np.pi, "deg"), "bias": (1000, "mm/s2 or mrad/s")}
XSENS_GRAVITY_M_S2 = 9.81744


def errors_of(found: RestCalibration, truth: SimulatedRests) -> tuple[np.ndarray, np.ndarray]:
    """(24,) errors and standard deviations, in the order of ``IMU_CALIBRATION_PARAMETERS``."""
    names = ("accel_gain", "accel_bias_m_s2", "gyro_gain", "gyro_bias_rad_s")
    calibration = found.calibration
    off = np.concatenate([(getattr(calibration, name) - getattr(truth, name)).ravel() for name in names])
    assert len(off) == IMU_CAL.COUNT
    return off, np.sqrt(np.diagonal(calibration.cov))


def study(options: RestOptions, runs: int, seed: int) -> dict[str, dict[str, float]]:
    """Coverage (per cent), and root mean squares of errors and of z, by kind of parameter."""
    errors, sigmas, refused, missed = [], [], 0, 0
    off_m_s2 = PRIORS.known_gravity_m_s2 * np.random.default_rng(seed).standard_normal(runs)
    for run in range(runs):
        truth = simulate_rests(options, seed=seed + run)
        try:
            found = calibrate_imu(
                truth.recording,
                gravity_m_s2=options.gravity_m_s2 + off_m_s2[run],
                gravity_sigma_m_s2=PRIORS.known_gravity_m_s2,
            )
        except NotObservableError:
            refused += 1
            continue
        missed += found.rests.attitudes != options.attitudes
        error, sigma = errors_of(found, truth)
        errors.append(error)
        sigmas.append(sigma)
    error, sigma = np.array(errors), np.array(sigmas)
    table = {}
    for kind, index in KINDS.items():
        z = error[:, index] / sigma[:, index]
        table[kind] = {
            "inside": 100 * float(np.mean(np.abs(z) < 1.96)),
            "z": float(np.sqrt(np.mean(z**2))),
            "error": float(np.sqrt(np.mean(error[:, index] ** 2))),
            "stated": float(np.sqrt(np.mean(sigma[:, index] ** 2))),
        }
    table["runs"] = {"refused": refused, "attitudes missed": missed}
    return table


def show(title: str, table: dict[str, dict[str, float]]) -> None:
    """Print one table."""
    runs = table.pop("runs")
    print(f"\n{title}: {runs['refused']} refused, attitudes missed in {runs['attitudes missed']}")
    print(f"{'parameter':<20}{'inside %':>9}{'z rms':>8}{'error rms':>12}{'stated':>10}  unit")
    for kind, row in table.items():
        factor, unit = UNITS[kind.split()[-1]]
        print(
            f"{kind:<20}{row['inside']:9.1f}{row['z']:8.2f}{factor * row['error']:12.4f}{factor * row['stated']:10.4f}"
            f"  {unit}"
        )


def read_xsens(path: Path) -> ImuRecording:
    """The table of raw counts by nominal zeros and factors."""
    with lzma.open(path) as file:
        values = np.genfromtxt(file, delimiter=",", skip_header=1)
    return ImuRecording(
        gyro_t_s=values[:, 0],
        gyro_rad_s=(values[:, 1:4] - 32768) / 6258,
        accel_t_s=values[:, 0],
        accel_m_s2=(values[:, 4:7] - 32768) / 414,
        device="Xsens MTi",
    )


def show_xsens(path: Path) -> None:
    """Print what becomes of the real rests."""
    found = calibrate_imu(
        read_xsens(path), gravity_m_s2=XSENS_GRAVITY_M_S2, gravity_sigma_m_s2=PRIORS.known_gravity_m_s2
    )
    turns = np.degrees(found.turn_residual_rad)
    print(f"\nXsens: {len(found.rests)} rests in {found.rests.attitudes} attitudes, verdict {found.verdict}")
    print(f"gravity over the rests: {found.rms_pct(found.before_m_s2):.2f} % rms before, ", end="")
    print(
        f"{found.rms_pct(found.after_m_s2):.4f} % after; turns miss it by {np.sqrt(np.nanmean(turns**2)):.2f} deg rms"
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--xsens", type=Path)
    args = parser.parse_args()
    options = RestOptions()
    show("phone, 12 attitudes", study(options, args.runs, args.seed))
    still = dataclasses.replace(options.imu, accel_walk_m_s3_rthz=0.0, gyro_walk_rad_s2_rthz=0.0)
    show(
        "the same, biases that stay", study(dataclasses.replace(options, imu=still), args.runs // 5, args.seed + 10_000)
    )
    for attitudes in (6, 8):
        few = dataclasses.replace(options, attitudes=attitudes)
        show(f"phone, {attitudes} attitudes", study(few, args.runs // 5, args.seed + 20_000 * attitudes))
    if args.xsens is not None:
        show_xsens(args.xsens)


if __name__ == "__main__":
    main()
