"""Choose the frames of a capture for the reconstruction; decided once and stored.

The gyroscope ranks frames before any is decoded, where its clock is known against the camera's: from the capture, or by
following the pixels of some frames. Otherwise their sharpness decides.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_inertial.core.arrays import Array, BoolArray, IndexArray
from colmap_inertial.core.camera_clock import CameraTimedImu
from colmap_inertial.core.errors import NotObservableError, fact_of
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import FrameOptions
from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.core.types import CameraModel, FrameTiming
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.psf import predict_blur_px
from colmap_inertial.imaging.selection import Chosen, Ranked, Ranking, WindowLimits, choose_frames
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.disk import remove
from colmap_inertial.io.files import a_record_of_ours, read_json, structured, without_sentences, write_json
from colmap_inertial.io.frame_sources import Video
from colmap_inertial.io.recording import Recording
from colmap_inertial.model import colmap_camera
from colmap_inertial.motion.align import AlignOptions, align_clocks
from colmap_inertial.motion.flow import check_motion
from colmap_inertial.run.preparation.frame_reading import FOLLOWED, RANKED, GreyFrames
from colmap_inertial.run.preparation.sampling import measure_sampled_rotation, names_at, sample_beginning
from colmap_inertial.run.steps.session import Session

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SelectionLimits:
    """Limits for ranking frames before a reconstruction."""

    #: Of several frames within so much time, the least blurred one is looked at.
    slot_s: float = 1 / 30
    #: Frames that are followed to find the offset between the clocks: how many, how far apart.
    followed_frames: int = 300
    followed_spacing_s: float = 0.06
    #: A rotation and an offset as good as these serve.
    rotation_rad: float = 0.1
    offset_s: float = 0.01
    #: Blur below this, for an image of 1920 px, cannot be seen.
    sharp_px: float = 1.0
    #: Exposure is at most this where it is unknown.
    usual_exposure_s: float = 1 / 60
    #: Angular speed is looked at in so many instants of an exposure.
    instants: int = 5


_LIMITS = SelectionLimits()


@dataclass(frozen=True, eq=False, kw_only=True)
class Selection:
    """Frames to use, and why.

    Attributes
    ----------
    names
        In order of time.
    frames
        How many the capture has.
    note
        How they were chosen.
    windows
        For each chosen frame; empty where all are used. Places count the capture's frames.
    offset_s, offset_sigma_s, offset_from
        Camera time = gyroscope stamp + offset, as used for ranking; ``offset_from`` is ``"capture"``, ``"pixels"`` or
        ``None``. From pixels, it holds in the middle of the frames that were followed; elsewhere the difference between
        the clocks' rates, which ``note`` states, adds to it.
    """

    names: tuple[str, ...]
    frames: int
    note: Fact
    windows: tuple[Chosen, ...] = ()
    offset_s: float | None = None
    offset_sigma_s: float | None = None
    offset_from: str | None = None

    def timing(self, every: FrameTiming) -> FrameTiming:
        """The timing of the frames to use."""
        return part_of(every, self.names)

    def as_json(self) -> dict[str, object]:
        """As JSON types: one list for each property of the windows, and the frames left out as ranges."""
        kept = [window.place for window in self.windows] if self.windows else list(range(self.frames))
        edges = [-1, *kept, self.frames]
        return {
            "frames": self.frames,
            "used": len(self.names),
            **with_sentences({"note": self.note}),
            "offset_s": self.offset_s,
            "offset_sigma_s": self.offset_sigma_s,
            "offset_from": self.offset_from,
            "windows": {
                key: [_plain(getattr(window, key)) for window in self.windows]
                for key in ("place", "first", "last", "closed_by", "ranked_by", "blur", "baseline", "motion")
            },
            "left_out": [[a + 1, b - 1] for a, b in itertools.pairwise(edges) if b - a > 1],
        }


def _plain(value: object) -> object:
    if isinstance(value, float):
        return None if np.isnan(value) else round(value, 4)
    return value


def part_of(timing: FrameTiming, names: Collection[str]) -> FrameTiming:
    """The timing of some frames."""
    wanted = set(names)
    keep = np.array([name in wanted for name in timing.names])
    return replace(
        timing,
        names=tuple(name for name in timing.names if name in wanted),
        t_s=timing.t_s[keep],
        exposure_s=None if timing.exposure_s is None else timing.exposure_s[keep],
    )


def everything(timing: FrameTiming, note: Fact) -> Selection:
    """All frames."""
    return Selection(names=timing.names, frames=len(timing.names), note=note)


def use_all(capture: Capture, options: FrameOptions) -> Fact | None:
    """Why all frames of a capture are used; ``None`` where they are to be selected."""
    if options.use == "all":
        return Fact("all-frames-asked")
    if options.use is None and not isinstance(capture.frames, Video):
        return Fact("all-pictures")
    if options.use is None and isinstance(capture.frames, Video) and capture.frames.frames_per_s is not None:
        return Fact("frames-as-capture-says")
    return None


def write_selection(path: Path, selection: Selection) -> None:
    """Write a selection for :func:`read_selection`."""
    windows = [{key: _or_none(value) for key, value in asdict(window).items()} for window in selection.windows]
    values = {f.name: getattr(selection, f.name) for f in fields(selection)}
    write_json(path, {**with_sentences(values), "windows": windows})


def _or_none(value: object) -> object:
    return None if isinstance(value, float) and np.isnan(value) else value


def _chosen(window: dict[str, Any]) -> Chosen:
    known: dict[str, Any] = {key: np.nan if value is None else value for key, value in window.items()}
    return Chosen(**known)


def read_selection(path: Path) -> Selection:
    """The selection that :func:`write_selection` wrote."""
    values: dict[str, Any] = without_sentences(read_json(path))
    with a_record_of_ours(path):
        windows = tuple(_chosen(window) for window in values.pop("windows"))
        names, note = tuple(values.pop("names")), structured(Fact, values.pop("note"))
        return Selection(**values, names=names, note=note, windows=windows)


def expect_selection(frames: GreyFrames, options: FrameOptions, capture: Capture) -> None:
    """Have frames kept that pass before they are ranked."""
    if use_all(capture, options) is None:
        frames.expect(FOLLOWED, names_at(frames.timing, _list_followed(frames.timing)))
        frames.expect(RANKED, frames.timing.names)


def _list_followed(timing: FrameTiming) -> list[int]:
    """Indices of the frames that are followed to find the offset between the clocks."""
    return sample_beginning(timing, _LIMITS.followed_spacing_s, _LIMITS.followed_frames)


def run_selection(session: Session, recording: Recording, options: FrameOptions, frames: GreyFrames) -> Selection:
    """The frames to use, by :func:`select_frames` or all of them."""
    selection_file = session.workspace.selection
    why_all = use_all(recording.capture, options)
    if why_all is not None:
        remove(selection_file)
        return everything(recording.timing, why_all)

    def work(partial: Sequence[Path]) -> None:
        write_selection(partial[0], select_frames(recording, options, frames, session.progress))

    session.runner.run("selection", {**recording.identity(), "frames": options}, [selection_file], work)
    selection = read_selection(selection_file)
    log.info("frames: %s", selection.note)
    return selection


@dataclass(frozen=True, eq=False, kw_only=True)
class _Clocks:
    """Clocks of gyroscope and camera before a reconstruction.

    ``motion`` is ``None`` where the offset is unknown; its orientation counts only where ``oriented``. The offset is as
    good as ``offset_sigma_s`` at ``middle_s``, camera clock, and worse the farther from there.
    """

    motion: GyroCamera | None
    oriented: bool
    camera: CameraModel
    note: Fact
    offset_s: float | None = None
    offset_sigma_s: float | None = None
    offset_from: str | None = None
    rate_sigma: float = 0.0
    middle_s: float = 0.0

    def usable(self, t_s: Array) -> BoolArray:
        """(N,) at which times the offset is good enough."""
        sigma_s = 0.0 if self.offset_sigma_s is None else self.offset_sigma_s
        return np.asarray(np.hypot(sigma_s, self.rate_sigma * (t_s - self.middle_s)) <= _LIMITS.offset_s)


def select_frames(recording: Recording, options: FrameOptions, frames: GreyFrames, progress: Progress) -> Selection:
    """Choose the frames to use: about ``min_fps`` to ``max_fps`` a second, each the least blurred of its window.

    Parameters
    ----------
    recording
        With the timing of all its frames.
    options
        How many.
    frames
        The images.
    progress
        Called with ``"clocks"`` and ``"selection"``.

    Raises
    ------
    FormatError
        For a frame that cannot be decoded.
    """
    timing = recording.timing
    with one_blas_thread():
        clocks = _clocks(recording, frames, progress)
        blur, ranking = _predicted(clocks, timing)
        looked = _slots(timing.t_s, blur)
        pose_t_s = timing.pose_t_s()[looked]
        turning = np.full((len(looked), 3, 3), np.nan)
        if clocks.motion is not None and clocks.oriented:
            turning = clocks.motion.start_from_cam(pose_t_s)
            turning[~(clocks.motion.covers(pose_t_s, pose_t_s) & clocks.usable(pose_t_s))] = np.nan
        sharp_px = _LIMITS.sharp_px * max(clocks.camera.width, clocks.camera.height) / 1920
        ranked = Ranked(
            t_s=timing.t_s[looked],
            blur=blur[looked],
            ranking=ranking,
            sharp_below=sharp_px if ranking == "blur" else 0.0,
            start_from_cam=turning,
        )
        names = [timing.names[i] for i in looked]
        images = report_each(frames.look(RANKED, names), len(names), "selection", progress)
        chosen = choose_frames(
            (image.grey for image in images),
            ranked,
            WindowLimits(shortest_s=1 / options.max_fps, longest_s=1 / options.min_fps),
            colmap_camera(clocks.camera),
            width=clocks.camera.width,
            height=clocks.camera.height,
        )
        windows = tuple(
            replace(w, place=int(looked[w.place]), first=int(looked[w.first]), last=int(looked[w.last])) for w in chosen
        )
    ways = {window.ranked_by for window in windows}
    return Selection(
        names=tuple(timing.names[window.place] for window in windows),
        frames=len(timing.names),
        note=Fact(
            "frames-selected",
            used=len(windows),
            frames=len(timing.names),
            ranked_by=sorted(ways),
            clocks=clocks.note,
        ),
        windows=windows,
        offset_s=clocks.offset_s,
        offset_sigma_s=clocks.offset_sigma_s,
        offset_from=clocks.offset_from,
    )


def _slots(t_s: Array, blur: Array) -> IndexArray:
    """The frames to look at: every one of a usual video, of a quicker one the least blurred in each slot."""
    slot = np.floor((t_s - t_s[0]) / _LIMITS.slot_s + 0.5).astype(np.int64)
    if len(t_s) < 2 or float(np.median(np.diff(t_s))) > 0.9 * _LIMITS.slot_s:
        return np.arange(len(t_s))
    order = np.lexsort((np.arange(len(t_s)), np.where(np.isnan(blur), np.inf, blur), slot))
    first = np.concatenate([[True], np.diff(slot[order]) > 0])
    return np.sort(order[first])


def _predicted(clocks: _Clocks, timing: FrameTiming) -> tuple[Array, Ranking]:
    """Rank of every frame, NaN where the gyroscope has no data, and its quantity."""
    motion = clocks.motion
    if motion is None:
        return np.full(len(timing.t_s), np.nan), "speed"
    if clocks.oriented and timing.exposure_s is not None:
        width, height = clocks.camera.width, clocks.camera.height
        blur = predict_blur_px(motion, colmap_camera(clocks.camera), timing, width=width, height=height).px
        return np.where(clocks.usable(timing.t_s), blur, np.nan), "blur"
    exposure_s = timing.exposure_s
    if exposure_s is None:
        step_s = float(np.median(np.diff(timing.t_s))) if len(timing.t_s) > 1 else np.inf
        exposure_s = np.full(len(timing.t_s), min(_LIMITS.usual_exposure_s, 0.5 * step_s))
    span_s = exposure_s + (timing.readout_s or 0.0)
    at_s = timing.t_s[:, None] + span_s[:, None] * (np.arange(_LIMITS.instants) + 0.5) / _LIMITS.instants
    speed = np.linalg.norm(motion.rate_in_cam_rad_s(at_s.ravel()), axis=1).reshape(at_s.shape).mean(axis=1)
    loss = speed if timing.exposure_s is None else speed * exposure_s
    known = motion.covers(timing.t_s, timing.t_s + span_s) & clocks.usable(timing.t_s)
    return np.where(known, loss, np.nan), "speed"


def _clocks(recording: Recording, frames: GreyFrames, progress: Progress) -> _Clocks:
    capture, imu, timing, prior = recording.capture, recording.imu, recording.timing, recording.prior
    camera = frames.guess_camera()
    rotation_rad = prior.rotation_sigma_rad
    offset_sigma_s = prior.clock_sigma_s
    known = _Clocks(
        motion=GyroCamera.of(imu, prior, camera_epoch_ns=timing.epoch_ns),
        oriented=rotation_rad <= _LIMITS.rotation_rad,
        camera=camera,
        note=Fact("offset-of-capture", sigma_s=offset_sigma_s),
        offset_s=prior.clock_offset_s,
        offset_sigma_s=offset_sigma_s,
        offset_from="capture",
    )
    if offset_sigma_s <= _LIMITS.offset_s and known.oriented:
        return known
    log_of = capture.frame_log
    if log_of is not None and log_of.in_video_time and capture.shared_clock and offset_sigma_s > _LIMITS.offset_s:
        # the recorder stamped frames and samples by one clock; measured on such files: some milliseconds
        offset_sigma_s = _LIMITS.offset_s
        known = replace(known, oriented=False, note=Fact("one-clock"), offset_sigma_s=offset_sigma_s)
    try:
        rotation = measure_sampled_rotation(frames, camera, _list_followed(timing), progress, stage="clocks")
        options = AlignOptions(max_offset_s=recording.max_offset_s)
        aligned = align_clocks(rotation.trajectory(), imu, prior=prior, options=options)
        calibration, on_rate, rate_sigma = aligned.calibration, imu, 0.0
        rate: float | None = None
        if aligned.drifts() or not (capture.shared_clock or offset_sigma_s <= _LIMITS.offset_s):
            # what one clock stamped has one rate; another is corrected even where it may be zero: what is left of it is
            # then as small as its deviation says
            rate_sigma = aligned.clock_rate_sigma
            on_rate = CameraTimedImu.from_recording(imu, calibration, timing.epoch_ns).imu
            rate = calibration.clock_rate
        sigma_s = calibration.clock_sigma_s
        turned = calibration.rotation_sigma_rad
        # what translation does to pixels looks like a bias of the gyroscope
        calibration = replace(calibration, gyro_bias_rad_s=prior.gyro_bias_rad_s)
        motion = GyroCamera.of(on_rate, calibration, camera_epoch_ns=timing.epoch_ns)
        agreement = check_motion(rotation, motion)
        if turned > _LIMITS.rotation_rad or sigma_s > _LIMITS.offset_s or agreement.agrees is not True:
            raise NotObservableError("clock offset", agreement.reason)
    except NotObservableError as error:
        if offset_sigma_s <= _LIMITS.offset_s:
            return replace(known, oriented=False)
        unknown = Fact("offset-unknown-beforehand", why=fact_of(error))
        return _Clocks(motion=None, oriented=False, camera=camera, note=unknown)
    return _Clocks(
        motion=motion,
        oriented=True,
        camera=camera if capture.camera is not None else _correct_focal(camera, agreement.gain),
        note=Fact("offset-by-pixels", sigma_s=sigma_s, rate=rate, rate_sigma=rate_sigma),
        offset_s=calibration.clock_offset_s,
        offset_sigma_s=sigma_s,
        offset_from="pixels",
        rate_sigma=rate_sigma,
        middle_s=calibration.clock_middle_s,
    )


def _correct_focal(camera: CameraModel, gain: tuple[float, float, float]) -> CameraModel:
    """A guessed camera, with the focal length for which pixels turn as far as the gyroscope felt."""
    known = [g for g in gain[:2] if np.isfinite(g)]
    if not known or not 0.4 < min(known) <= max(known) < 2.5:
        return camera
    return replace(camera, params=(camera.params[0] * float(np.mean(known)), *camera.params[1:]))
