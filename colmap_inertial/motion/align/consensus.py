"""Cameras of a reconstruction that contradict the gyroscope, and the alignment by those that agree.

With a camera's pose, the rotation between camera and IMU and the integrated gyroscope,

    D_i = world_from_cam_i cam_from_imu (start_from_imu(t_i))^-1

is the same for all cameras of a sound model. It jumps at a camera in the wrong place and jumps back after it; where a
model is torn, it jumps and stays. Gain errors of the gyroscope let it wander by degrees over a minute, so that cameras
are compared only with those next to them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import Array, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply, quat_normalize
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording, RotationConsensus
from colmap_inertial.motion.align import Alignment, AlignOptions, align_clocks, align_trimmed


@dataclass(frozen=True, kw_only=True)
class ConsensusLimits:
    """Limits of agreement with the gyroscope."""

    #: Cameras agree to within this, or to within so many standard deviations of the steps between them (whose median
    #: is 1.538 standard deviations of an axis) ...
    least_deg: float = 2.0
    sigmas: float = 6.0
    #: ... but no worse than this.
    most_deg: float = 10.0
    #: A gyroscope's bias and gain leave so much of time and of rotation.
    drift_deg_s: float = 0.05
    drift_share: float = 0.015
    #: Parts that differ by less are one, with a bend.
    seam_deg: float = 5.0
    #: Cameras that agree are a part of the model from this number, share and time on; fewer are single cameras.
    fewest: int = 4
    share: float = 0.08
    shortest_s: float = 1.0
    #: Cameras that an end of a part is the mean of.
    beside: int = 5
    #: Fewer judged cameras have no majority.
    fewest_judged: int = 8
    #: Rounds of aligning by the cameras that agree.
    rounds: int = 3


LIMITS = ConsensusLimits()
#: Codes of refusals where it is open which cameras are right.
NO_MAJORITY = frozenset({"too-few-cameras-judged", "no-majority-of-cameras"})


@one_blas_thread()
def align_by_consensus(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
    together: Alignment | NotObservableError | None = None,
) -> tuple[Alignment, RotationConsensus]:
    """Align a camera and an IMU by the cameras of a reconstruction that agree with the gyroscope.

    As :func:`align_clocks` where all do. Where cameras contradict it, the others are aligned once more without them,
    parts of a torn model turned to fit; by the same search, which refuses as ever.

    Parameters
    ----------
    trajectory, imu, prior, options
        As of :func:`align_clocks`.
    together
        What this found or refused by them, where that is known already.

    Returns
    -------
    Alignment, RotationConsensus
        The latter of every camera of the trajectory.

    Raises
    ------
    NotObservableError
        As :func:`align_clocks`, and where most cameras do not agree on one part.
    """
    aligned: Alignment | None = None
    before = np.zeros(len(trajectory), dtype=np.intp)
    try:
        if isinstance(together, NotObservableError):
            raise together
        aligned = together or align_clocks(trajectory, imu, prior=prior, options=options)
        calibration = aligned.calibration
    except NotObservableError:
        trimmed = align_trimmed(trajectory, imu, prior=prior, options=options)
        if trimmed is None:
            raise
        calibration = trimmed
    for _ in range(LIMITS.rounds):
        consensus = judge_rotations(trajectory, imu, calibration)
        if aligned is not None and np.array_equal(consensus.part, before):
            break
        before = consensus.part
        aligned = align_clocks(_mend_rotations(trajectory, consensus), imu, prior=prior, options=options)
        calibration = aligned.calibration
    assert aligned is not None
    if not consensus.kept.all():
        _require_majority(consensus)
    return aligned, consensus


def _mend_rotations(trajectory: CameraTrajectory, consensus: RotationConsensus) -> CameraTrajectory:
    """Rotations without those of wrong cameras, parts turned to fit."""
    sound = consensus.part >= 0
    part_from_ref = quat_conjugate(consensus.ref_from_part_xyzw)[consensus.part[sound]]
    some = trajectory.select(sound)
    return replace(some, cam_from_world_xyzw=quat_multiply(some.cam_from_world_xyzw, part_from_ref))


def _require_majority(consensus: RotationConsensus) -> None:
    """Refuse where it is open which cameras are right: the largest part is no larger than all others together."""
    part = consensus.part[consensus.judged]
    count, placed, largest = len(part), int(np.sum(part >= 0)), int(np.sum(part == 0))
    if count < LIMITS.fewest_judged:
        raise NotObservableError("camera rotation", Fact("too-few-cameras-judged", judged=count))
    if 2 * placed <= count or 2 * largest <= placed:
        raise NotObservableError("camera rotation", Fact("no-majority-of-cameras", largest=largest, judged=count))


def describe_consensus(consensus: RotationConsensus) -> tuple[Fact, ...]:
    """Describe contradictions to the gyroscope; empty where there are none."""
    out = []
    wrong, count = consensus.wrong, len(consensus.names)
    if wrong:
        deviations_deg = [camera.deviation_deg for camera in wrong]
        names = [camera.name for camera in wrong]
        out.append(Fact("cameras-left-out", names=names, deviations_deg=deviations_deg, cameras=count))
    if consensus.moved:
        out.append(Fact("cameras-misplaced", names=consensus.moved, cameras=count))
    out += [Fact("model-torn", before=seam.before, after=seam.name, turn_deg=seam.turn_deg) for seam in consensus.seams]
    if consensus.seams:
        kept = int(consensus.kept.sum())
        if consensus.joined:
            out.append(Fact("torn-parts-joined", joined=len(consensus.joined), kept=kept, cameras=count))
        if any(consensus.part[consensus.names.index(name)] > 0 for name in consensus.left_out):
            whole = Fact("largest-part-kept", kept=kept, cameras=count)
            out.append(Fact("other-parts-left-out") if consensus.joined else whole)
    return tuple(out)


def without_consensus(facts: Iterable[Fact]) -> tuple[Fact, ...]:
    """Facts but for those of :func:`describe_consensus`."""
    return tuple(fact for fact in facts if fact.code not in _CODES)


#: The codes of :func:`describe_consensus`.
_CODES = frozenset(
    (
        "cameras-left-out",
        "cameras-misplaced",
        "model-torn",
        "torn-parts-joined",
        "largest-part-kept",
        "other-parts-left-out",
    )
)


def judge_rotations(
    trajectory: CameraTrajectory, imu: ImuRecording, calibration: CameraImuCalibration
) -> RotationConsensus:
    """Compare each camera of a reconstruction with the gyroscope and the cameras around it.

    Parameters
    ----------
    trajectory, imu
        A reconstruction and the IMU recording. Cameras outside of it are not judged; those on either side
        of a pause of the gyroscope are not compared with each other.
    calibration
        Of the two, from :func:`align_by_consensus` or ``align_clocks``.
    """
    timed = CameraTimedImu(imu=imu, calibration=calibration, camera_epoch_ns=trajectory.epoch_ns)
    t_s = trajectory.t_s - calibration.drift_s(trajectory.t_s) - timed.gyro_offset_s
    path = GyroPath(imu.gyro_t_s, imu.gyro_rad_s, calibration.gyro_bias_rad_s)
    inside = np.flatnonzero((t_s >= path.t_s[0]) & (t_s <= path.t_s[-1]))
    world_from_imu = quat_multiply(quat_conjugate(trajectory.cam_from_world_xyzw), calibration.cam_from_imu_xyzw)
    swept_rad = np.cumsum(np.linalg.norm(path.rate_rad_s, axis=1) * np.gradient(path.t_s))
    recorded = _Recorded(
        t_s=t_s[inside],
        world_from_start=quat_multiply(world_from_imu, quat_conjugate(path.at(t_s)[0]))[inside],
        swept_deg=np.degrees(np.interp(t_s, path.t_s, swept_rad))[inside],
    )
    gaps = np.flatnonzero(~path.covers(recorded.t_s[:-1], recorded.t_s[1:])) + 1
    parts = _Parts.none()
    for stretch in np.split(np.arange(len(inside)), gaps):
        parts = parts.join(_find_parts(recorded.select(stretch), recorded.agreement_deg, len(inside)))
    deviation, part = np.zeros(len(trajectory)), np.full(len(trajectory), -2)
    deviation[inside], part[inside] = parts.deviation_deg, parts.number
    judged = part != -2
    # those that were not judged go with the nearest in time that belong somewhere
    placed = np.flatnonzero(part >= 0)
    if len(placed):
        nearest = np.rint(np.interp(t_s[~judged], t_s[placed], np.arange(len(placed)))).astype(np.intp)
        part[~judged] = part[placed[nearest]]
    else:
        part[~judged] = 0
    return RotationConsensus(
        names=trajectory.names,
        t_s=trajectory.t_s,
        judged=judged,
        deviation_deg=deviation,
        part=part,
        ref_from_part_xyzw=parts.ref_from_part_xyzw,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Recorded:
    """Cameras that the gyroscope recorded: gyroscope times, ``D``, and how far the camera has turned in all."""

    t_s: Array
    world_from_start: Array
    swept_deg: Array

    def select(self, index: IndexArray) -> _Recorded:
        return _Recorded(
            t_s=self.t_s[index], world_from_start=self.world_from_start[index], swept_deg=self.swept_deg[index]
        )

    @property
    def steps_deg(self) -> Array:
        """Change of ``D`` from each camera to the next."""
        return _angles_deg(self.world_from_start[:-1], self.world_from_start[1:])

    @property
    def agreement_deg(self) -> float:
        """Tolerance of the agreement of neighbours."""
        usual = float(np.median(self.steps_deg)) / 1.538 if len(self.t_s) > 1 else 0.0
        return float(np.clip(LIMITS.sigmas * usual, LIMITS.least_deg, LIMITS.most_deg))

    def allowed_deg(self, within_deg: float, i: IndexArray | int, j: IndexArray | int) -> Array:
        """Tolerance between two cameras, including the gyroscope's drift from one to the other."""
        drift = LIMITS.drift_deg_s * np.abs(self.t_s[j] - self.t_s[i])
        drift = drift + LIMITS.drift_share * np.abs(self.swept_deg[j] - self.swept_deg[i])
        return np.minimum(within_deg + drift, max(within_deg, LIMITS.most_deg))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Parts:
    """Part of each camera, its deviation, and the rotation of each part against the first.

    A wrong camera's part is -1; that of one that was not judged -2.
    """

    number: IndexArray
    deviation_deg: Array
    ref_from_part_xyzw: Array

    @classmethod
    def none(cls) -> _Parts:
        """The parts of no cameras, with a largest part of none."""
        return cls(number=np.zeros(0, int), deviation_deg=np.zeros(0), ref_from_part_xyzw=np.array([[0.0, 0, 0, 1]]))

    def join(self, later: _Parts) -> _Parts:
        """Those of a later stretch, too; the largest part of each is the largest of all."""
        shifted = np.where(later.number > 0, later.number + len(self.ref_from_part_xyzw) - 1, later.number)
        return _Parts(
            number=np.concatenate([self.number, shifted]),
            deviation_deg=np.concatenate([self.deviation_deg, later.deviation_deg]),
            ref_from_part_xyzw=np.concatenate([self.ref_from_part_xyzw, later.ref_from_part_xyzw[1:]]),
        )


def _find_parts(cameras: _Recorded, within_deg: float, count: int) -> _Parts:
    """The parts of a stretch without gaps, of so many cameras in all."""
    n, d = len(cameras.t_s), cameras.world_from_start
    steps = np.arange(n - 1)
    cuts = np.flatnonzero(cameras.steps_deg > cameras.allowed_deg(within_deg, steps, steps + 1)) + 1
    runs = np.split(np.arange(n), cuts)
    fewest = max(LIMITS.fewest, LIMITS.share * count)
    long = [len(run) >= fewest and cameras.t_s[run[-1]] - cameras.t_s[run[0]] >= LIMITS.shortest_s for run in runs]
    if not any(long) and n < LIMITS.fewest_judged:
        return replace(_Parts.none(), number=np.full(n, -2), deviation_deg=np.zeros(n))
    number = np.full(n, -1)
    seam_deg = max(within_deg, LIMITS.seam_deg)
    latest: list[IndexArray] = []
    first_from_part: list[Array] = []
    before = -1
    for run in (run for run, is_long in zip(runs, long, strict=True) if is_long):
        begin = run[: LIMITS.beside]
        facing = [end[-LIMITS.beside :] for end in latest]
        apart = np.array([_apart_deg(d, end, begin) for end in facing])
        allowed = np.array([float(cameras.allowed_deg(seam_deg, int(end[-1]), int(run[0]))) for end in facing])
        if np.any(apart <= allowed):
            before = int(np.argmin(np.where(apart <= allowed, apart, np.inf)))
            latest[before] = run
        else:
            turn = np.array([0.0, 0.0, 0.0, 1.0])
            if latest:
                turn = quat_multiply(_mean(d[facing[before]]), quat_conjugate(_mean(d[begin])))
                turn = quat_multiply(first_from_part[before], turn)
            first_from_part.append(turn)
            latest.append(run)
            before = len(latest) - 1
        number[run] = before
    number = _place_short_runs(cameras, runs, long, number, within_deg)
    deviation = _deviations_deg(cameras, number)
    if not latest:
        return replace(_Parts.none(), number=number, deviation_deg=deviation)
    # the largest part is the first
    sizes = np.bincount(number[number >= 0], minlength=len(latest))
    order = np.argsort(-sizes, kind="stable")
    rank = np.append(np.argsort(order), -1)
    turned = np.array(first_from_part)[order]
    return _Parts(
        number=rank[number],
        deviation_deg=deviation,
        ref_from_part_xyzw=quat_multiply(quat_conjugate(turned[0]), turned),
    )


def _place_short_runs(
    cameras: _Recorded, runs: Sequence[IndexArray], long: Sequence[bool], number: IndexArray, within_deg: float
) -> IndexArray:
    """Parts of cameras with those that agree with the end of a part beside them."""
    number, of_long = number.copy(), np.flatnonzero(long)
    for k in np.flatnonzero(~np.array(long)).tolist():
        beside = [runs[j][-LIMITS.beside :] for j in of_long[of_long < k][-1:]]
        beside += [runs[j][: LIMITS.beside] for j in of_long[of_long > k][:1]]
        for i in runs[k]:
            for end in beside:
                nearest = int(end[np.argmin(np.abs(end - i))])
                apart = _apart_deg(cameras.world_from_start, end, [i])
                if number[i] < 0 and apart <= cameras.allowed_deg(within_deg, nearest, i):
                    number[i] = number[nearest]
    return number


def _deviations_deg(cameras: _Recorded, number: IndexArray) -> Array:
    """Deviation of each camera from the next four of its part; of a wrong one, from the nearest five placed."""
    d, out = cameras.world_from_start, np.zeros(len(number))
    placed = np.flatnonzero(number >= 0)
    if not len(placed):
        return out
    for part in np.unique(number):
        own = np.flatnonzero(number == part)
        if part >= 0:
            at = np.abs(np.arange(len(own))[:, None] + [-2, -1, 1, 2])
            sides = [own[np.minimum(at, 2 * (len(own) - 1) - at)]]  # beyond an end, those before it
        else:
            at = np.searchsorted(placed, own)[:, None]
            reach = np.arange(LIMITS.beside)
            sides = [placed[np.clip(at + beside, 0, len(placed) - 1)] for beside in (reach, -1 - reach)]
        out[own] = np.min([_angles_deg(_mean(d[side]), d[own]) for side in sides], axis=0)
    return out


def _mean(q: Array) -> Array:
    """(..., 4) means of (..., K, 4) rotations that are alike."""
    alike = np.where(np.sum(q * q[..., :1, :], axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return quat_normalize(np.sum(q * alike, axis=-2))


def _apart_deg(q: Array, some: IndexArray, others: IndexArray | Sequence[int]) -> float:
    return float(_angles_deg(_mean(q[some]), _mean(q[np.asarray(others)])))


def _angles_deg(a: Array, b: Array) -> Array:
    """(...,) angles between rotations."""
    return np.degrees(np.linalg.norm(quat_log(quat_multiply(quat_conjugate(a), b)), axis=-1))
