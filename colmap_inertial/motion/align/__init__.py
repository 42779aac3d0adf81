"""Camera-IMU alignment: rotation, time offset and gyroscope bias from the gyroscope against visual rotation.

Step 1 of Mustaniemi et al., "Inertial-based scale estimation for structure from motion on mobile devices" (IROS 2017),
with three changes. Every offset at which the two recordings could coincide is searched, because clock origins are
arbitrary, and clocks may run at different rates. Rotations over intervals between frames are compared instead of
differentiated orientations, so that video and sparse keyframes are treated in the same way. And a result is refused
where no offset is clearly better than the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.camera_clock import epoch_shift_s
from colmap_inertial.core.choices import CheckedOptions
from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.gyro import GyroPath
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraImuCalibration, CameraTrajectory, ImuRecording
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.motion.align._clock_search import (
    TRIMMED,
    ClockFit,
    intervals_of,
    measure_explained_share,
    search_offsets,
    select_spaced_frames,
)
from colmap_inertial.motion.align._fit import OFFSET_UNKNOWN_FROM_S, Alignment, middle_of_overlap, refine_alignment

#: Frames closer together than the first have turned by less than the noise of their poses; over the second, the noise
#: of poses is small against the rotation that is to be explained.
_SPACING_S, _CHECK_SPACING_S = 0.1, 0.3
#: Below this there is no interval long enough to tell one offset from another.
_SHORTEST_S = 1.0
#: Where the clocks drift apart too far for one offset, parts of this length still have one; how many of them are
#: tried; the largest drift (action cameras: 1 %), and how far the parts may lie off a steady drift.
_PART_S, _PARTS, _FASTEST_DRIFT, _UNSTEADY_S = 15.0, 8, 0.02, 0.2

#: Of rotations some of which are wrong, at least this share follows the gyroscope; they turn as far as it does to
#: within this factor (a wrong unit is a factor of 57, of counts any); and its mirror image is likelier by so much (in
#: nats) at most.
_LEAST_SOUND, _GAIN_WITHIN, _MOST_MIRRORED = 0.5, 1.5, 3.0

#: Offsets are searched within so many standard deviations of a known one, and this; it counts at most so many nats:
#: what is known may be wrong six times in a million, as often as an offset that is accepted.
_REACH_SIGMAS, _REACH_S, _MOST_PRIOR = 10, 0.05, 12.0

#: Rotation within a second, rms, below which the camera counts as still: what noise of poses looks like.
_STILL_RAD_RTS = 0.015


@dataclass(frozen=True, kw_only=True)
class AlignOptions(CheckedOptions):
    """Options of the alignment of the clocks of camera and IMU."""

    max_offset_s: float | None = None
    """Largest offset between raw stamps to consider; 1 for a shared clock. Without it, every offset is searched."""

    min_overlap: float = 0.25
    """Smallest part of the shorter recording that the other one must cover for an offset to be considered."""

    min_log_likelihood: float = 12.0
    """How much likelier, in nats, the offset must be than the next best one and than no relation at all.

    Where two recordings have nothing in common, the gap between the best offset and the next is distributed roughly
    as an exponential of mean one, so that 12 would be exceeded 6 times in a million.
    """

    min_explained: float = 0.75
    """Smallest part of the camera's rotation over 0.3 s that the gyroscope must explain, where none of it is wrong."""


def align_camera_imu(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> CameraImuCalibration:
    """Rotation, time offset and gyroscope bias between a camera and an IMU.

    As :func:`align_clocks`, without the clock rate: for clocks that keep step, which all but action cameras' do.
    """
    calibration = align_clocks(trajectory, imu, prior=prior, options=options).calibration
    return replace(calibration, clock_rate=0.0, clock_middle_s=0.0)


@one_blas_thread()
def align_clocks(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> Alignment:
    """Rotation, time offset, clock rate and gyroscope bias between a camera and an IMU.

    Parameters
    ----------
    trajectory
        At least five poses; only their rotations are used. Video and keyframes seconds apart both serve.
    imu
        Only the gyroscope is used.
    prior
        What is known beforehand (``io.calibration.calibration_prior`` builds one). Its lever arm, readout and
        accelerometer delay pass through; a time offset with a standard deviation below ``OFFSET_UNKNOWN_FROM_S``
        narrows the search to ten standard deviations (and 0.05 s), and counts beside what rotations say. Where the
        search cannot find the rotation by itself, a known rotation is held.
    options
        Search range and thresholds.

    Rotations of which some are wrong, as those of two views are, spoil least squares over all of them. Where these
    find no offset, a mixture of sound and wrong rotations does (``_robust.py``), by what the sound ones say.

    Returns
    -------
    The calibration has a covariance in the order of ``CALIBRATION_PARAMETERS``. It is that of generalised least
    squares with pose noise (white, per frame) and gyroscope noise (random walk) estimated from the residuals, and
    with gyroscope gain, misalignment, rolling shutter and clock rate as nuisance parameters; then widened per
    parameter to what the scatter between twelve parts of the recording shows. It describes the very rotations that
    were used here: as a prior of a second estimate from the same recording it would count them twice.

    Raises
    ------
    NotObservableError
        Where no offset is clearly better than the others (another recording's IMU, no rotation, rotation that repeats
        itself), where the recordings cannot overlap, or where turning about one axis only leaves the rotation open.
    """
    search = _search(trajectory, imu, prior, options)
    prior = search.prior
    rate = 0.0
    start = search.whole(trajectory)
    if isinstance(start, NotObservableError):
        drifting = search.parts(trajectory)
        if drifting is not None:
            start, rate = drifting
        else:
            mixed = search.mixture(trajectory)
            if mixed is None:
                raise start
            start = mixed
    keep = select_spaced_frames(trajectory.t_s, _SPACING_S)
    return refine_alignment(trajectory.select(keep), imu, start, prior, clock_rate=rate)


def align_trimmed(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> CameraImuCalibration | None:
    """Start where some poses are wrong: the search of :func:`align_clocks` with the rotations that fit best.

    ``None`` where no offset is clearly better than the rest by 85 % of the intervals, nor by 70 %.
    """
    search = _search(trajectory, imu, prior, options)
    for share in TRIMMED.shares:
        start = search.whole(trajectory, share)
        if isinstance(start, ClockFit):
            return start.apply_to(search.prior, epoch_shift_s(imu, trajectory.epoch_ns))
    return None


def coarse_fit(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    *,
    prior: CameraImuCalibration | None = None,
    options: AlignOptions | None = None,
) -> ClockFit | NotObservableError:
    """Start of :func:`align_clocks` where the clocks keep step, with its evidence; or the reason why there is none."""
    try:
        return _search(trajectory, imu, prior, options).whole(trajectory)
    except NotObservableError as error:
        return error


def _search(
    trajectory: CameraTrajectory,
    imu: ImuRecording,
    prior: CameraImuCalibration | None,
    options: AlignOptions | None,
) -> _Search:
    options = options or AlignOptions()
    prior = prior or calibration_prior()
    if len(trajectory) < 5:
        raise NotObservableError("time offset", Fact("too-few-poses-to-align", poses=len(trajectory)))
    span_s = float(trajectory.t_s[-1] - trajectory.t_s[0])
    if span_s < _SHORTEST_S:
        raise NotObservableError("time offset", Fact("poses-too-short", span_s=span_s))
    return _Search(
        path=GyroPath(imu.gyro_t_s, imu.gyro_rad_s, np.zeros(3)),
        offsets_s=_range(trajectory, imu, prior, options),
        shift_s=epoch_shift_s(imu, trajectory.epoch_ns),
        prior=prior,
        options=options,
    )


def _range(
    trajectory: CameraTrajectory, imu: ImuRecording, prior: CameraImuCalibration, options: AlignOptions
) -> tuple[float, float]:
    """Lowest and highest offset between times since the two epochs."""
    shift_s = epoch_shift_s(imu, trajectory.epoch_ns)
    lowest_s, highest_s = -np.inf, np.inf
    if options.max_offset_s is not None:
        lowest_s, highest_s = shift_s - options.max_offset_s, shift_s + options.max_offset_s
    centre_s, reach_s = prior.clock_offset_s + shift_s, searched_around_s(prior)
    return max(lowest_s, centre_s - reach_s), min(highest_s, centre_s + reach_s)


def searched_around_s(prior: CameraImuCalibration) -> float:
    """How far from a known offset the clocks are searched; infinite where none is known."""
    if prior.clock_sigma_s >= OFFSET_UNKNOWN_FROM_S:
        return float(np.inf)
    return _REACH_SIGMAS * prior.clock_sigma_s + _REACH_S


@dataclass(frozen=True, eq=False, kw_only=True)
class _Search:
    """Search for the offset: the gyroscope, lowest and highest offset, the epochs' shift, priors, thresholds."""

    path: GyroPath
    offsets_s: tuple[float, float]
    shift_s: float
    prior: CameraImuCalibration
    options: AlignOptions

    def whole(self, trajectory: CameraTrajectory, share: float = 1.0) -> ClockFit | NotObservableError:
        """The coarse fit of a share of the intervals, or the reason why there is none."""
        intervals = intervals_of(trajectory, _SPACING_S if share == 1 else TRIMMED.spacing_s)
        spaced = intervals_of(trajectory, _CHECK_SPACING_S)
        rotation_known, options = self.prior.rotation_sigma_rad < 0.2, self.options
        for held in (None, self.prior.cam_from_imu_xyzw) if rotation_known else (None,):
            fits = search_offsets(
                intervals,
                self.path,
                self.offsets_s,
                min_overlap=options.min_overlap,
                cam_from_imu_xyzw=held,
                share=share,
            )
            if not fits:
                return NotObservableError("time offset", Fact("no-overlap"))
            best, ahead = self._best(fits)
            explained = measure_explained_share(spaced, self.path, best.offset_s, held, share)
            if ahead >= options.min_log_likelihood and explained >= options.min_explained:
                return best
        seconds = intervals_of(trajectory, _SHORTEST_S)
        if np.sqrt(np.mean(np.sum(seconds.turn_rad**2, axis=1) / seconds.dt_s)) < _STILL_RAD_RTS:
            return NotObservableError("camera-IMU rotation", Fact("camera-hardly-rotates"))
        if explained < options.min_explained:
            return NotObservableError("time offset", Fact("no-offset-fits", explained=explained))
        return NotObservableError("time offset", Fact("offset-ambiguous"))

    def _best(self, fits: list[ClockFit]) -> tuple[ClockFit, float]:
        """The likeliest fit, and how much likelier it is (nats), with what is known beforehand of the offset: than each
        other one, and than no relation, by which it may be anywhere in the range.
        """
        sigma_s, known_s = self.prior.clock_sigma_s, self.prior.clock_offset_s + self.shift_s
        off = np.array([fit.offset_s - known_s for fit in fits]) / sigma_s
        known = sigma_s < OFFSET_UNKNOWN_FROM_S
        counts = -np.minimum(0.5 * off**2, _MOST_PRIOR) if known else np.zeros(len(fits))
        total = counts + [fit.log_likelihood for fit in fits]
        best = int(np.argmax(total))
        lead = float(total[best] - np.delete(total, best).max(initial=-np.inf))
        range_s = self.offsets_s[1] - self.offsets_s[0]
        expected = float(np.log(range_s / (sigma_s * np.sqrt(2 * np.pi))) + counts[best]) if known else 0.0
        return fits[best], min(lead, fits[best].log_likelihood + max(expected, 0.0))

    def mixture(self, trajectory: CameraTrajectory) -> ClockFit | None:
        """The coarse fit of sound rotations among wrong ones; ``None`` where they do not tell an offset from others."""
        intervals, options, prior = intervals_of(trajectory, TRIMMED.spacing_s), self.options, self.prior
        for held in (None, prior.cam_from_imu_xyzw) if prior.rotation_sigma_rad < 0.2 else (None,):
            fits = search_offsets(
                intervals,
                self.path,
                self.offsets_s,
                min_overlap=options.min_overlap,
                cam_from_imu_xyzw=held,
                share=None,
            )
            if not fits:
                return None
            best, ahead = self._best(fits)
            if (
                ahead >= options.min_log_likelihood
                and best.explained >= _LEAST_SOUND
                and 1 / _GAIN_WITHIN <= best.gain <= _GAIN_WITHIN
                and best.mirrored <= best.log_likelihood + _MOST_MIRRORED
            ):
                return best
        return None

    def parts(self, trajectory: CameraTrajectory) -> tuple[ClockFit, float] | None:
        """Offset in the middle and clock rate from short parts, if at least two of them agree on a steady drift."""
        t_s = trajectory.t_s
        if t_s[-1] - t_s[0] < 2 * _PART_S:
            return None
        fits: list[tuple[float, ClockFit]] = []
        for begin_s in np.linspace(t_s[0], t_s[-1] - _PART_S, _PARTS):
            part = trajectory.select((t_s >= begin_s) & (t_s <= begin_s + _PART_S))
            if len(part) >= 5:
                fit = self.whole(part)
                if isinstance(fit, ClockFit):
                    fits.append((begin_s + 0.5 * _PART_S, fit))
        best: tuple[int, float, float] | None = None
        for i, (time_i, fit_i) in enumerate(fits):
            for time_j, fit_j in fits[i + 1 :]:
                rate = (fit_j.offset_s - fit_i.offset_s) / (time_j - time_i)
                at_zero_s = fit_i.offset_s - rate * time_i
                agreeing = sum(abs(fit.offset_s - at_zero_s - rate * time) < _UNSTEADY_S for time, fit in fits)
                if abs(rate) <= _FASTEST_DRIFT and (best is None or agreeing > best[0]):
                    best = (agreeing, rate, at_zero_s)
        if best is None or best[0] < max(2, (len(fits) + 1) // 2):
            return None
        _, rate, at_zero_s = best
        middle_s = middle_of_overlap(trajectory, self.path.t_s, at_zero_s + rate * 0.5 * float(t_s[0] + t_s[-1]))
        return replace(fits[0][1], offset_s=at_zero_s + rate * middle_s), rate


__all__ = [
    "OFFSET_UNKNOWN_FROM_S",
    "AlignOptions",
    "Alignment",
    "align_camera_imu",
    "align_clocks",
    "align_trimmed",
    "coarse_fit",
    "searched_around_s",
]
