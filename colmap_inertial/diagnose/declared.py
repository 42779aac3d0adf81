"""Declared rotation and time offset of camera and IMU against an estimate that was made without them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from colmap_inertial.core.arrays import Array
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.types import CAL, CameraImuCalibration
from colmap_inertial.io.calibration import SIGMAS, reset_for_recording
from colmap_inertial.motion.align import searched_around_s


@dataclass(frozen=True, kw_only=True)
class DeclaredLimits:
    """Limits beyond which a recording contradicts what was declared."""

    #: A rotation known worse is none that was declared, and none that contradicts.
    known_rotation_rad: float = 0.2
    #: What matters, in standard deviations, too; and what makes a scale wrong. By images alone, the latter alone.
    rotation_rad: float = 0.05
    wrong_rotation_rad: float = 0.35
    sigmas: float = 4.0
    #: Offsets known worse were not declared; and what matters of others.
    known_offset_s: float = 0.1
    offset_s: float = 0.01
    offset_by_pictures_s: float = 0.03


_LIMITS = DeclaredLimits()

#: What a declared value is likelier to be: of the other direction, order, sign or unit; empty for none of them.
Likely = Literal["", "inverse", "order", "axes", "sign", "milliseconds"]


@dataclass(frozen=True, kw_only=True)
class Contradicted:
    """What was declared and is contradicted; ``None`` for what is not.

    Attributes
    ----------
    rotation, time_offset
        As facts.
    is_wrong_rotation, is_wrong_offset
        Whether an estimate that starts from them is wrong, too.
    """

    rotation: Fact | None = None
    time_offset: Fact | None = None
    is_wrong_rotation: bool = False
    is_wrong_offset: bool = False

    @property
    def facts(self) -> tuple[Fact, ...]:
        """All of it; empty where nothing is contradicted."""
        return tuple(fact for fact in (self.rotation, self.time_offset) if fact is not None)


def leave_out(
    declared: CameraImuCalibration, *, rotation: bool = True, time_offset: bool = True
) -> CameraImuCalibration:
    """What is declared but for rotation and time offset; the same object where neither is declared."""
    out = declared
    if time_offset and declared.clock_sigma_s <= _LIMITS.known_offset_s:
        out = reset_for_recording(out)
    if rotation and declared.rotation_sigma_rad <= _LIMITS.known_rotation_rad:
        cov = out.cov.copy()
        cov[CAL.ROTATION, :] = cov[:, CAL.ROTATION] = 0.0
        cov[CAL.ROTATION, CAL.ROTATION] = SIGMAS.unknown_rotation_rad**2 * np.eye(3)
        out = replace(out, cov=cov)
    return out


def compare_declared(declared: CameraImuCalibration, found: CameraImuCalibration, *, by_poses: bool) -> Contradicted:
    """Compare what is declared with what a recording shows.

    Parameters
    ----------
    declared, found
        The latter by an alignment without the former (:func:`leave_out`).
    by_poses
        Whether cameras of a reconstruction were aligned, not images that were followed.
    """
    rotation, is_wrong_rotation = _compare_rotation(declared, found, by_poses=by_poses)
    offset, is_wrong_offset = _compare_offset(declared, found, by_poses=by_poses)
    return Contradicted(
        rotation=rotation, time_offset=offset, is_wrong_rotation=is_wrong_rotation, is_wrong_offset=is_wrong_offset
    )


def _compare_rotation(
    declared: CameraImuCalibration, found: CameraImuCalibration, *, by_poses: bool
) -> tuple[Fact | None, bool]:
    larger_sigma = max(declared.rotation_sigma_rad, found.rotation_sigma_rad)
    if larger_sigma > _LIMITS.known_rotation_rad:
        return None, False
    sigma = float(np.hypot(declared.rotation_sigma_rad, found.rotation_sigma_rad))
    within = max(_LIMITS.rotation_rad if by_poses else _LIMITS.wrong_rotation_rad, _LIMITS.sigmas * sigma)
    stated = declared.cam_from_imu_xyzw

    def angle_to(xyzw: Array) -> float:
        return float(np.linalg.norm(quat_log(quat_multiply(found.cam_from_imu_xyzw, quat_conjugate(xyzw)))))

    angle = angle_to(stated)
    if angle <= within:
        return None, False
    others: dict[Likely, Array] = {
        "inverse": quat_conjugate(stated),
        "order": np.roll(stated, -1),
        # y up and z back, as graphics have them
        "axes": quat_multiply(np.array([1.0, 0.0, 0.0, 0.0]), stated),
    }
    likely = min(others, key=lambda name: angle_to(others[name]))
    fact = Fact(
        "declared-rotation",
        angle_deg=np.degrees(angle),
        sigma_deg=np.degrees(sigma),
        likely=likely if angle_to(others[likely]) <= within else "",
    )
    return fact, angle > _LIMITS.wrong_rotation_rad + 3 * larger_sigma


def _compare_offset(
    declared: CameraImuCalibration, found: CameraImuCalibration, *, by_poses: bool
) -> tuple[Fact | None, bool]:
    if max(declared.clock_sigma_s, found.clock_sigma_s) > _LIMITS.known_offset_s:
        return None, False
    sigma_s = float(np.hypot(declared.clock_sigma_s, found.clock_sigma_s))
    within_s = max(_LIMITS.offset_s if by_poses else _LIMITS.offset_by_pictures_s, _LIMITS.sigmas * sigma_s)
    stated_s, found_s = declared.clock_offset_s, found.clock_offset_s
    if abs(found_s - stated_s) <= within_s:
        return None, False
    others: dict[Likely, float] = {"sign": -stated_s, "milliseconds": 1e-3 * stated_s}
    likely = min(others, key=lambda name: abs(found_s - others[name]))
    fact = Fact(
        "declared-offset",
        declared_s=stated_s,
        found_s=found_s,
        sigma_s=sigma_s,
        likely=likely if abs(found_s - others[likely]) <= within_s else "",
    )
    return fact, abs(found_s - stated_s) > searched_around_s(declared)
