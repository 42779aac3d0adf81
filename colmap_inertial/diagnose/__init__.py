"""Check a capture before any reconstruction: findings, each with a code, evidence and advice.

A check is a function of what was recorded (:class:`Recorded`) that yields :class:`Finding` values; it opens no file by
itself (``Recorded.images`` decodes frames). ``CHECKS`` lists all of them. ``run.preparation.preflight`` reads
captures for them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from colmap_inertial.core.errors import InertialError, TimingError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.diagnose import camera, clocks, frames, imu
from colmap_inertial.diagnose.diagnosis import SEVERITIES, Diagnosis, Finding, FramesInVideo, Recorded, Severity

Check = Callable[[Recorded], Iterable[Finding]]

#: Every check, in the order in which findings of one severity are shown.
CHECKS: tuple[Check, ...] = (
    imu.check_plausibility,
    imu.check_accelerometer,
    imu.check_repairs,
    imu.check_rate,
    imu.check_pauses,
    imu.check_together,
    imu.check_cut_off,
    imu.check_resolution,
    imu.check_scatter,
    imu.check_delay,
    camera.check_declared,
    camera.check_stabilisation,
    camera.check_pose_convention,
    clocks.check_time_unit,
    camera.check_belonging,
    imu.check_axes,
    camera.check_cameras,
    camera.check_gyro_gain,
    clocks.check_clock_rate,
    clocks.check_coverage,
    clocks.check_even_times,
    camera.check_focal_length,
    camera.check_accelerometer_sign,
    imu.check_motion_content,
    frames.check_cut_from_video,
    frames.check_dropped,
    frames.check_repeated,
    frames.check_blank,
    frames.check_exposure,
    frames.check_unstated_exposure,
    frames.check_readout,
)


@one_blas_thread()
def diagnose(recorded: Recorded) -> Diagnosis:
    """Look for everything that is known to go wrong.

    Parameters
    ----------
    recorded
        What there is; what could not be read is a finding, too, and the rest is checked all the same.
    """
    findings = [unreadable(error) for error in recorded.refused]
    for check in CHECKS:
        findings += check(recorded)
    findings.sort(key=lambda finding: -SEVERITIES.index(finding.severity))
    parts = {
        "gyroscope": recorded.imu is not None,
        "accelerometer": recorded.imu is not None and recorded.imu.has_accel,
        "frame times": recorded.timing is not None,
        "pictures": recorded.is_dense,
        "pictures far apart": not recorded.is_dense and recorded.turning is not None and recorded.trajectory is None,
        "poses": recorded.trajectory is not None,
        "source video": recorded.in_video is not None,
    }
    return Diagnosis(findings=tuple(findings), checked=tuple(name for name, there in parts.items() if there))


#: What a reader refuses stamps for, whose facts name the file.
_FAULTS_OF_STAMPS = frozenset(
    {"time-unit", "stamps-reversed", "stamps-jump-back", "stamps-damaged", "stamps-too-coarse"}
)


def unreadable(error: InertialError) -> Finding:
    """A reader's error as a finding."""
    if error.code in _FAULTS_OF_STAMPS:
        return Finding(fact=error.fact, severity="error")
    code = "untimed" if isinstance(error, TimingError) else "unreadable"
    return Finding(fact=Fact(code, detail=str(error)), severity="error")


__all__ = [
    "CHECKS",
    "Check",
    "Diagnosis",
    "Finding",
    "FramesInVideo",
    "Recorded",
    "Severity",
    "diagnose",
    "unreadable",
]
