"""How much the joint scale depends on each constant that its authors chose; ``scripts.benchmarks.scale --sensitivity``.

Each constant is halved and doubled in turn (one with an upper bound moves half the way to it instead). Then, for each
constant, leave one recording out: the setting among half, default and double with the smallest mean absolute error on
the other recordings is used on the one left out. If choosing on some recordings helped on another, the errors that
result would be below the default's; where they are above, what looks like a better value is chance. The last row
chooses among all settings of all constants at once.

The alignment is estimated once per window and kept, so that only the joint estimator's constants act. Those of the
camera-IMU calibration's prior (lever arm, readout, delay between the sensors) are varied in that calibration's
covariance. Interval and refusal limits do not act on the error and are left alone.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration
from colmap_inertial.inertial.core import parameters, priors
from colmap_inertial.inertial.core.priors import PRIORS
from colmap_inertial.inertial.scale import _noise, _residuals, _setup, interval, joint
from colmap_inertial.motion.align import align_camera_imu
from scripts.benchmarks import scale as bench_scale
from scripts.benchmarks.scale import Window

#: Windows by the name of their column: the first minute, and its twelfth parts.
SCOPES = ("60 s", "parts")
#: Rows of the calibration's covariance by the name of the constant that stands in them.
_IN_CALIBRATION = {"lever_in_plane": (8, 9), "lever_along_axis": (10,), "accel_delay": (4,), "readout": (11,)}
_PRIVATE = {
    "_setup._COUNTED_ONCE": _setup,
    "_setup._NEAR_M": _setup,
    "_setup._FAR_M": _setup,
    "interval._UNMODELLED_S": interval,
    "parameters.DRIFT_S": parameters,
    "_noise._LARGEST_CORRELATION": _noise,
    "_residuals.ROBUST_SIGMAS": _residuals,
}
_UPPER_BOUNDS = {"_noise._LARGEST_CORRELATION": 1.0}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One constant at half or double its value; ``constant=""`` changes nothing."""

    constant: str = ""
    factor: float = 1.0

    def of(self, default: float) -> float:
        bound = _UPPER_BOUNDS.get(self.constant)
        if bound is not None and self.factor > 1:
            return bound - (bound - default) / self.factor
        return default * self.factor


@dataclass(frozen=True, kw_only=True)
class Found:
    """Error in % (None: refused), and whether the interval holds the truth."""

    error: float | None
    inside: bool


def constants() -> dict[str, float | None]:
    """All that are varied, with their defaults; None where the calibration's covariance holds the value."""
    known = [f.name for f in dataclasses.fields(PRIORS) if not f.name.startswith(("calibrated", "known"))]
    out: dict[str, float | None] = {f"PRIORS.{name}": getattr(PRIORS, name) for name in known}
    levels = dataclasses.fields(_noise.TYPICAL)
    from_stream = ("rotation_excess", "gyro_density_rad_s_rthz", "accel_density_m_s2_rthz")
    out |= {f"TYPICAL.{f.name}": getattr(_noise.TYPICAL, f.name) for f in levels if f.name not in from_stream}
    out["JointOptions.states_hz"] = joint.JointOptions().states_hz
    out |= {name: getattr(module, name.partition(".")[2]) for name, module in _PRIVATE.items()}
    out |= {f"calibration.{name}": None for name in _IN_CALIBRATION}
    return out


@contextmanager
def applied(setting: Setting) -> Iterator[joint.JointOptions]:
    """The joint estimator with one constant changed; the options to call it with."""
    place, _, name = setting.constant.partition(".")
    options = joint.JointOptions()
    if place == "PRIORS":
        changed = dataclasses.replace(PRIORS, **{name: setting.of(getattr(PRIORS, name))})
        if name == "gravity_m_s2":
            options = joint.JointOptions(gravity_sigma_m_s2=changed.gravity_m_s2)
        with ExitStack() as stack:
            for module in (_setup, interval, joint, priors):
                stack.enter_context(mock.patch.object(module, "PRIORS", changed))
            yield options
    elif place == "TYPICAL":
        typical = dataclasses.replace(_noise.TYPICAL, **{name: setting.of(getattr(_noise.TYPICAL, name))})
        with mock.patch.object(_noise, "TYPICAL", typical):
            yield options
    elif setting.constant in _PRIVATE:
        module = _PRIVATE[setting.constant]
        with mock.patch.object(module, name, setting.of(getattr(module, name))):
            yield options
    elif place == "JointOptions":
        yield joint.JointOptions(**{name: setting.of(getattr(options, name))})
    else:
        yield options


def changed_calibration(calibration: CameraImuCalibration, setting: Setting) -> CameraImuCalibration:
    """The calibration with a wider or narrower prior, where that is the setting."""
    place, _, name = setting.constant.partition(".")
    if place != "calibration":
        return calibration
    cov = calibration.cov.copy()
    if name == "accel_delay":
        # The accelerometer's offset is the gyroscope's plus the delay: what it has beyond that one is the delay's
        cov[4, 4] += (setting.factor**2 - 1) * (cov[3, 3] + cov[4, 4] - 2 * cov[3, 4])
        return dataclasses.replace(calibration, cov=cov)
    factors = np.ones(len(cov))
    factors[list(_IN_CALIBRATION[name])] = setting.factor
    return dataclasses.replace(calibration, cov=cov * factors[:, None] * factors)


def align(window: Window) -> CameraImuCalibration | None:
    """A window's alignment, None where it is refused."""
    trajectory, imu, _ = window.read()
    try:
        return align_camera_imu(trajectory, imu)
    except NotObservableError:
        return None


def run(task: tuple[Window, CameraImuCalibration | None, Setting]) -> Found:
    """The joint estimate of one window with one setting."""
    window, calibration, setting = task
    if calibration is None:
        return Found(error=None, inside=False)
    trajectory, imu, truth = window.read()
    with one_blas_thread(), applied(setting) as options:
        timed = CameraTimedImu.from_recording(imu, changed_calibration(calibration, setting), trajectory.epoch_ns)
        estimate = joint.estimate_joint(trajectory, timed, options)
    if estimate.metres_per_unit is None or estimate.ci95 is None:
        return Found(error=None, inside=False)
    low, high = estimate.ci95
    return Found(error=100 * (estimate.metres_per_unit / truth - 1), inside=low <= truth <= high)


def study(folders: Sequence[Path], processes: int) -> dict[str, Any]:
    """Run and print the study; what is printed, as numbers."""
    windows = [window for folder in folders for window in bench_scale.first_windows(folder, (60.0,), ())]
    windows += [window for folder in folders for window in bench_scale.part_windows(folder, (12,))]
    calibrations = bench_scale.each(align, windows, processes, "aligning")
    names = constants()
    settings = [Setting()] + [Setting(constant=name, factor=factor) for name in names for factor in (0.5, 2.0)]
    tasks = [
        (window, calibration, setting)
        for setting in settings
        for window, calibration in zip(windows, calibrations, strict=True)
    ]
    found = bench_scale.each(run, tasks, processes, "varying constants")
    table = np.array([np.nan if f.error is None else abs(f.error) for f in found]).reshape(len(settings), -1)
    inside = np.array([f.inside for f in found]).reshape(table.shape)
    results = {setting: _Row(table[i], inside[i], windows) for i, setting in enumerate(settings)}
    return {"rows": _print_varied(names, results), "leave_one_out": _print_left_out(names, results, folders)}


@dataclass(frozen=True, eq=False)
class _Row:
    """All windows with one setting: absolute errors in %, NaN where refused."""

    error: Array
    inside: Array
    windows: Sequence[Window]

    def _of(self, scope: str) -> Array:
        return np.array([(window.group == "first 60 s") == (scope == "60 s") for window in self.windows])

    def figures(self, scope: str) -> dict[str, float | int]:
        error, inside = self.error[self._of(scope)], self.inside[self._of(scope)]
        refused = int(np.sum(np.isnan(error)))
        mean = float(np.nanmean(error)) if refused < len(error) else np.nan
        return {"mean": mean, "inside": int(inside.sum()), "windows": len(error), "refused": refused}

    @functools.cache  # noqa: B019 - a few dozen rows that live as long as the process
    def by_recording(self, scope: str) -> dict[Path, float]:
        """Mean absolute error of each recording; infinite where nothing was estimated."""
        out = {}
        for folder in dict.fromkeys(window.folder for window in self.windows):
            own = np.array([window.folder == folder for window in self.windows]) & self._of(scope)
            error = self.error[own & ~np.isnan(self.error)]
            out[folder] = float(error.mean()) if len(error) else np.inf
        return out


def _print_varied(names: dict[str, float | None], results: dict[Setting, _Row]) -> list[dict[str, Any]]:
    print("Mean absolute error in %, and how many intervals hold the truth (of the first 60 s | of their 12 parts)")
    print(f"{'constant':<30}{'default':>9}  {'halved':^29}  {'doubled':^29}")
    out: list[dict[str, Any]] = []

    def cells(setting: Setting) -> str:
        text = ""
        for scope in SCOPES:
            f = results[setting].figures(scope)
            out.append({"constant": setting.constant, "factor": setting.factor, "scope": scope, **f})
            refused = f" -{f['refused']}" if f["refused"] else ""
            text += f"{f['mean']:6.2f}" + f" {f['inside']}/{f['windows']}{refused}".ljust(9)
        return text

    print(f"{'(none)':<39}  {cells(Setting())}")
    for name, value in names.items():
        default = "" if value is None else f"{value:g}"
        print(f"{name:<30}{default:>9}  " + " ".join(cells(Setting(constant=name, factor=f)) for f in (0.5, 2.0)))
    return out


def _print_left_out(
    names: dict[str, float | None], results: dict[Setting, _Row], folders: Sequence[Path]
) -> list[dict[str, Any]]:
    print("\nLeave one recording out: mean absolute error in % with the setting that is best on the others")
    print(f"{'constant':<30}{'60 s':>8}{'default':>9}   chosen      {'parts':>8}{'default':>9}   chosen")
    out: list[dict[str, Any]] = []
    groups = {name: [Setting(), *(Setting(constant=name, factor=f) for f in (0.5, 2.0))] for name in names}
    groups["(any one of them)"] = list(results)
    for name, settings in groups.items():
        line = f"{name:<30}"
        for scope in SCOPES:
            errors, factors = [], []
            for left in folders:
                others = [folder for folder in folders if folder != left]

                def elsewhere(setting: Setting, others: list[Path] = others, scope: str = scope) -> float:
                    by_recording = results[setting].by_recording(scope)
                    return float(np.mean([by_recording[folder] for folder in others]))

                best = min(settings, key=elsewhere)
                errors.append(results[best].by_recording(scope)[left])
                factors.append(best.factor)
            default = float(np.mean(list(results[Setting()].by_recording(scope).values())))
            counts = {factor: factors.count(factor) for factor in (0.5, 1.0, 2.0)}
            chosen = " ".join(f"{n}x{factor:g}" for factor, n in counts.items() if n)
            line += f"{np.mean(errors):8.2f}{default:9.2f}   {chosen:<12}"
            out.append(
                {"constant": name, "scope": scope, "error": float(np.mean(errors)), "default": default}
                | {"chosen": {str(factor): n for factor, n in counts.items()}}
            )
        print(line)
    return out
