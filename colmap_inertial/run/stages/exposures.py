"""Frames of short and long exposures: each pair becomes the one image that COLMAP sees."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from colmap_inertial.core.arrays import AnyArray, Float32Array
from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.facts import Fact, with_sentences
from colmap_inertial.core.options import ExposureOptions
from colmap_inertial.core.threads import frames_at_once, map_in_order
from colmap_inertial.core.types import Frame, Projector, Treatment
from colmap_inertial.imaging.exposure_pairs import (
    Brightness,
    ExposurePair,
    PairGyro,
    better_alone,
    brightened,
    bring_together,
    darken_fused,
    fuse_mertens,
)
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_images import LongExposures, LongTiming
from colmap_inertial.io.files import path_in
from colmap_inertial.io.frame_sources import ImageFolder, image_names
from colmap_inertial.io.images import read_image
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.stages.imaging_plan import GyroView
from colmap_inertial.run.stages.inputs import Fuser, StageInputs


def fuses_pairs(capture: Capture, options: ExposureOptions, *, deblur: str | None) -> bool:
    """Whether frames are made of pairs; what stands against it is said before any work.

    Raises
    ------
    InertialError
        Where deblurring was asked for by name, too.
    FormatError
        Where a long exposure is missing.
    """
    if capture.exposures is None or not options.fuse:
        return False
    if deblur not in (None, "off"):
        raise InertialError(Fact("fused-not-deblurred", deblur=deblur))
    assert isinstance(capture.frames, ImageFolder)
    capture.exposures.files(image_names(capture.frames))
    return True


@dataclass(frozen=True, kw_only=True)
class FusedPair:
    """Treatment of one pair.

    Attributes
    ----------
    name, long
        Of the frame, and the file of its long exposure.
    fused
        Whether one image was made of them.
    used
        ``both``, or the better one of the two: the short one, brightened, or the long one as it is.
    reason
        Why.
    gain, colours
        By what the short one's light was multiplied, and what each channel's gain is of it.
    gain_measured, gain_stated
        By the pixels, and by exposure times and sensitivities; ``None`` where unknown.
    by_gyro, by_pixels
        What the alignment rests on.
    agreement, agreement_before
        Correlation of the pictures' detail, and what it was without alignment.
    shift_px
        Median length of the shift between them.
    blur_px
        90th percentile of the long one's blur that the gyroscope predicts; ``None`` where unknown.
    covered_share, clipped_share
        Of the image: what the long one covers, and where it may have clipped.
    """

    name: str
    long: str
    fused: bool
    used: Literal["both", "short", "long"]
    reason: Fact
    gain: float | None = None
    colours: tuple[float, ...] | None = None
    gain_measured: float | None = None
    gain_stated: float | None = None
    by_gyro: bool | None = None
    by_pixels: bool | None = None
    agreement: float | None = None
    agreement_before: float | None = None
    shift_px: float | None = None
    blur_px: float | None = None
    covered_share: float | None = None
    clipped_share: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ExposureStage:
    """The frame stage that fuses pairs of exposures.

    Takes the short ones, reads the long ones beside them, and yields images with the short ones' names, times,
    geometry and depth, as bright as the long ones. Two or more are worked on at once; the order stays, and memory does
    not grow with their number.

    Attributes
    ----------
    pictures
        Where the long ones are.
    folder
        Of the short ones.
    fuser
        What makes one image of two.
    fusion
        Whether the result is blended with the short exposure.
    view
        Gyroscope, camera and times of the short ones; ``None`` aligns by the pixels alone.
    long
        Times of the long ones; ``None`` where unknown, then, too, the pixels alone align.
    workers
        Pairs in work at once; as many as the process has processors, up to four, where absent.
    """

    pictures: LongExposures
    folder: Path
    fuser: Fuser
    fusion: Literal["none", "mertens"] = "none"
    view: GyroView | None = None
    long: LongTiming | None = None
    workers: int | None = field(default=None, compare=False)

    @classmethod
    def for_run(cls, inputs: StageInputs) -> ExposureStage | None:
        """The stage of a run, where pairs are fused; without exposure times, the pixels alone align them.

        Raises
        ------
        TimingError
            As ``LongExposures.timing``.
        """
        capture, timing = inputs.recording.capture, inputs.recording.timing
        if inputs.fuser is None or capture.exposures is None:
            return None
        return cls.of_capture(
            capture,
            inputs.options.exposures,
            inputs.fuser,
            view=None if timing.exposure_s is None else inputs.plan.view,
            long=capture.exposures.timing(timing),
        )

    @classmethod
    def of_capture(
        cls,
        capture: Capture,
        options: ExposureOptions,
        fuser: Fuser,
        *,
        view: GyroView | None = None,
        long: LongTiming | None = None,
    ) -> ExposureStage:
        """The stage for a capture with pairs, of which the times may be unknown."""
        assert capture.exposures is not None and isinstance(capture.frames, ImageFolder)
        return cls(
            pictures=capture.exposures,
            folder=capture.frames.folder,
            fuser=fuser,
            fusion=options.fusion,
            view=view,
            long=long,
        )

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Fuse the pairs, in order."""
        exposures_s = {} if self.long is None else dict(zip(self.long.names, self.long.exposure_s, strict=True))
        work = partial(self._fused, gyro=self._gyro(), long_exposures_s=exposures_s)
        for frame, done in map_in_order(work, frames, workers=self.workers or frames_at_once()):
            if done is None:
                yield frame
                continue
            treatment = Treatment(stage="exposures", reason=done.reason, values={"pair": with_sentences(vars(done))})
            yield replace(frame, treatments=(*frame.treatments, treatment))

    def _gyro(self) -> Callable[[str], PairGyro | None]:
        """The gyroscope's part for each name."""
        if self.view is None or self.long is None:
            return lambda name: None
        view, long = self.view, self.long
        motion: GyroCamera = view.motion()
        camera: Projector = colmap_camera(view.camera)
        index, place = view.index(), {name: i for i, name in enumerate(long.names)}

        def of(name: str) -> PairGyro | None:
            if name not in index or name not in place:
                return None
            short, i = view.shutter(index[name]), place[name]
            later = replace(short, t_s=float(long.t_s[i]), exposure_s=float(long.exposure_s[i]))
            return PairGyro(motion=motion, camera=camera, short=short, long=later)

        return of

    def _fused(
        self, frame: Frame, *, gyro: Callable[[str], PairGyro | None], long_exposures_s: Mapping[str, float]
    ) -> tuple[Frame, FusedPair | None]:
        if frame.dropped:
            return frame, None
        path = self.pictures.path(frame.name)
        long = read_image(path)
        _require_alike(frame, path, long)
        times = gyro(frame.name)
        if times is not None:
            _require_size(path_in(self.folder, frame.name), frame, times.short)
        stated = self.pictures.stated_gain(
            path_in(self.folder, frame.name),
            path,
            short_exposure_s=frame.exposure_s,
            long_exposure_s=long_exposures_s.get(frame.name),
        )
        try:
            pair = bring_together(frame.image, long, gyro=times, stated_gain=stated)
        except NotObservableError as error:
            return _alone(frame, long, None, path, error.fact)
        measured = _measured(pair)
        if not pair.registered.alike:
            why = Fact("pair-not-alike", long=path.name, correlation=pair.registered.agreement)
            return _alone(frame, long, pair.brightness, path, why, measured)
        light = self.fuser.fuse(pair.short, pair.long, pair.blur)
        if self.fusion == "mertens":
            dark = brightened(frame.image, replace(pair.brightness, gain=1.0))
            light = fuse_mertens([darken_fused(light, dark, pair.clipped, pair.brightness.gain), light])
        reason = _describe_pair(pair, path)
        done = FusedPair(name=frame.name, long=str(path), fused=True, used="both", reason=reason, **measured)
        return _replace_light(frame, light), done


def _alone(
    frame: Frame,
    long: AnyArray,
    brightness: Brightness | None,
    path: Path,
    why: Fact,
    measured: Mapping[str, Any] | None = None,
) -> tuple[Frame, FusedPair]:
    """The better one of the two, never a dark one."""
    alone = better_alone(frame.image, long, brightness)
    reason = Fact("exposures-not-fused", used=alone.used, gain=alone.gain, why=why)
    treated = FusedPair(
        name=frame.name, long=str(path), fused=False, used=alone.used, reason=reason, **(measured or {})
    )
    if alone.used == "short":
        treated = replace(treated, gain=alone.gain)
    return _replace_light(frame, alone.image), treated


def _replace_light(frame: Frame, light: Float32Array) -> Frame:
    top = np.iinfo(frame.image.dtype).max
    image: Any = np.rint(top * np.clip(light, 0, 1)).astype(frame.image.dtype)  # either of two types of pixel
    return replace(frame, image=image)


def _require_alike(frame: Frame, path: Path, long: AnyArray) -> None:
    height, width = frame.image.shape[:2]
    if long.shape[:2] != (height, width):
        raise FormatError(
            path,
            Fact(
                "long-exposure-of-other-size",
                width=long.shape[1],
                height=long.shape[0],
                frame=frame.name,
                short_width=width,
                short_height=height,
            ),
        )
    if long.shape != frame.image.shape:
        kinds = ["grey" if image.ndim == 2 else "in colour" for image in (long, frame.image)]
        raise FormatError(
            path, Fact("long-exposure-of-other-kind", kind=kinds[0], frame=frame.name, short_kind=kinds[1])
        )
    if long.dtype != frame.image.dtype:
        raise FormatError(
            path,
            Fact(
                "long-exposure-of-other-depth",
                dtype=str(long.dtype),
                frame=frame.name,
                short_dtype=str(frame.image.dtype),
            ),
        )


def _require_size(path: Path, frame: Frame, shutter: FrameShutter) -> None:
    height, width = frame.image.shape[:2]
    if (width, height) != (shutter.width, shutter.height):
        raise FormatError(
            path,
            Fact(
                "picture-unlike-the-camera",
                width=width,
                height=height,
                camera_width=shutter.width,
                camera_height=shutter.height,
            ),
        )


def _measured(pair: ExposurePair) -> dict[str, Any]:
    """The figures of a pair that was brought together."""
    bright, registered = pair.brightness, pair.registered
    return dict(
        gain=bright.gain,
        colours=bright.colours,
        gain_measured=bright.measured,
        gain_stated=bright.stated,
        by_gyro=registered.by_gyro,
        by_pixels=registered.by_pixels,
        agreement=registered.agreement,
        agreement_before=registered.untouched,
        shift_px=float(np.median(np.hypot(registered.shift_px[..., 0], registered.shift_px[..., 1]))),
        blur_px=None if pair.blur is None else float(np.percentile(pair.blur.extent_px(), 90)),
        covered_share=float(pair.covered.mean()),
        clipped_share=float(pair.clipped.mean()),
    )


def _describe_pair(pair: ExposurePair, path: Path) -> Fact:
    note, bright = pair.gyro_note, pair.brightness
    return Fact(
        "exposures-fused",
        long=path.name,
        gain=bright.gain,
        by_gyro=pair.registered.by_gyro,
        by_pixels=pair.registered.by_pixels,
        # that there is none is said for the whole recording
        no_gyro=None if note is None or note.code == "no-gyroscope" else note,
        contradicted_gain=bright.stated if bright.contradicts else None,
    )
