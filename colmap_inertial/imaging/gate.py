"""The safety gate of deblurring: which frames to touch, and nothing that the image does not confirm.

Deconvolving what is sharp, or along a wrong direction, destroys more than blur does. So a frame is deblurred only
where its own cepstrum shows the blur that the gyroscope predicts, or other frames of the recording have shown that
the gyroscope is right and this one does not contradict; the extent is corrected to what the images show; and places
in a deblurred frame that were sharp before keep their pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_inertial.core.arrays import Array, BoolArray, Float32Array, set_fields
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath
from colmap_inertial.imaging.detail import is_blank
from colmap_inertial.imaging.evidence import BlurEvidence, blur_evidence, measure_blur_share
from colmap_inertial.imaging.gyro_camera import GyroCamera
from colmap_inertial.imaging.psf import PredictedBlur
from colmap_inertial.imaging.tracking import convert_to_grey

Code = TypeVar("Code", np.uint8, np.uint16)


class Decision(StrEnum):
    """What to do with a frame, by the gyroscope alone."""

    #: As filmed.
    KEEP = "keep"
    DEBLUR = "deblur"
    DROP = "drop"


@dataclass(frozen=True, kw_only=True)
class GateOptions:
    """Options of the choice of frames to deblur. Blur is the 90th percentile over the image, scaled to an image 1920 px
    wide.
    """

    skip_below_px: float = 3.0
    """Images with less blur are left alone."""

    skip_below_own_px: float = 2.0
    """Images with less blur, in their own pixels, are left alone: a filter may lose more than it gains."""

    drop_above_px: float = 45.0
    """Frames with more blur are left out, unless they bridge a gap."""

    bridge_s: float = 0.5
    """Longest pause that leaving out frames may open."""

    bridge_deg: float = 10.0
    """Largest rotation of the camera that leaving out frames may open."""

    min_support: float = 4.0
    """Standard deviations by which one frame alone must show the predicted blur."""

    min_recording_support: float = 2.5
    """Standard deviations by which the median frame must show it, for the gyroscope to be trusted in all."""

    def __post_init__(self) -> None:
        if self.skip_below_own_px < 0:
            raise ValueError("skip_below_own_px must not be negative")
        if not 0 <= self.skip_below_px < self.drop_above_px:
            raise ValueError("skip_below_px must be from 0 to below drop_above_px")
        if not (self.bridge_s > 0 and self.bridge_deg > 0):
            raise ValueError("bridge_s and bridge_deg must be positive")


@dataclass(frozen=True, kw_only=True)
class FrameDecision:
    """Decision on one frame, with the reason.

    Attributes
    ----------
    name
        Of the frame.
    blur_px
        Predicted, px of the image as it is; ``None`` where unknown.
    action
        What to do with it.
    reason
        Why.
    """

    name: str
    blur_px: float | None
    action: Decision
    reason: Fact

    def __post_init__(self) -> None:
        set_fields(self, action=Decision(self.action), reason=as_fact(self.reason))


def decide(
    predicted: PredictedBlur,
    t_s: Array,
    *,
    width: int,
    height: int,
    motion: GyroCamera | None = None,
    options: GateOptions | None = None,
) -> tuple[FrameDecision, ...]:
    """Keep, deblur or drop each frame, from the gyroscope alone.

    Parameters
    ----------
    predicted
        Of all frames, in order of time.
    t_s
        (F,) their times.
    width, height
        Size of the images.
    motion
        Tells how far the camera rotated across a gap; without it, only the pause counts.
    options
        Thresholds.
    """
    options = options or GateOptions()
    scale = max(width, height) / 1920
    px = predicted.px
    dropped = _find_droppable(px > options.drop_above_px * scale, px, t_s, motion, options)
    out = []
    for name, blur, reason, drop in zip(predicted.names, px, predicted.reasons, dropped, strict=True):
        if not np.isfinite(blur):
            why = reason or Fact("blur-unknown")
            out.append(FrameDecision(name=name, blur_px=None, action=Decision.KEEP, reason=why))
            continue
        action, code = Decision.DEBLUR, "blur-px"
        if blur < max(options.skip_below_px * scale, options.skip_below_own_px):
            action, code = Decision.KEEP, "blur-too-short"
        elif drop:
            action, code = Decision.DROP, "blur-too-long"
        elif blur > options.drop_above_px * scale:
            code = "blur-bridges-gap"
        blur_px = float(blur)
        out.append(FrameDecision(name=name, blur_px=blur_px, action=action, reason=Fact(code, blur_px=blur_px)))
    return tuple(out)


def _find_droppable(
    candidate: BoolArray, px: Array, t_s: Array, motion: GyroCamera | None, options: GateOptions
) -> BoolArray:
    """Candidates that can be dropped, the most blurred first, without too wide a gap between those that stay."""
    looking = None if motion is None else motion.start_from_cam(t_s)
    stays = np.ones(len(px), dtype=np.bool_)
    before, after = np.arange(len(px)) - 1, np.arange(len(px)) + 1
    for i in sorted(np.flatnonzero(candidate), key=lambda k: -px[k]):
        left, right = before[i], after[i]
        if left >= 0 and right < len(px):
            turn_deg = 0.0
            if looking is not None:
                cosine = 0.5 * (np.trace(looking[left].T @ looking[right]) - 1)
                turn_deg = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
            if t_s[right] - t_s[left] > options.bridge_s or turn_deg > options.bridge_deg:
                continue
        stays[i] = False
        if left >= 0:
            after[left] = right
        if right < len(px):
            before[right] = left
    return ~stays


@dataclass(frozen=True, kw_only=True)
class GateLimits:
    """Limits of the gate, beside the options."""

    #: An extent is corrected where it is off by a larger share,
    corrected_from: float = 0.1
    #: and by more than the dip of small blur drifts,
    drift_px: float = 1.2
    #: and where the dip is this clear (standard deviations).
    clear_support: float = 7.0
    #: Blur this long must show in a frame with texture.
    must_show_px: float = 8.0
    #: Blur that is known no better than this, as a share of its length, is left alone: a filter along a line that is
    #: off by a third or 20 degrees loses what it wins.
    most_unsure: float = 0.25
    #: Where the gyroscope's sign is in doubt, frames whose paths leave their chords by no more than this are deblurred:
    #: with the other sign, their blur is the same to this, px.
    straight_px: float = 0.5
    #: A frame that shows less of the fall that its blur predicts is not blurred so. Blurred ones show .7 of it, the
    #: fewest .2 (textures with a direction of their own), sharp ones .05 +- .1.
    least_share: float = 0.25
    #: Sharp textures with a direction of their own show up to this, but no dip: in doubt, longer blur must show one.
    clear_share: float = 0.5
    #: Standard deviations by which all frames together must show short blur: of wrong gyroscopes, none reached three.
    together_support: float = 4.5
    #: From so many standard deviations on, a frame has a vote whether it is rather the gyroscope's direction, or the
    #: mirrored one.
    vote_support: float = 2.5
    #: Fewer frames do not tell whether the gyroscope is right.
    fewest_frames: int = 3


GATE_LIMITS = GateLimits()


@dataclass(frozen=True, kw_only=True)
class RecordingVerdict:
    """Whether the images of a recording confirm its gyroscope.

    Attributes
    ----------
    trusted
        ``None`` where too few frames are blurred and textured enough to tell: then each frame speaks for itself.
    support
        Median over the frames that can tell, in standard deviations.
    extent_factor
        What the predicted extents must be multiplied by to agree with the images.
    frames
        How many can tell.
    reason
        Why.
    """

    trusted: bool | None
    support: float
    extent_factor: float
    frames: int
    reason: Fact

    def __post_init__(self) -> None:
        set_fields(self, reason=as_fact(self.reason))


def judge_recording(evidence: Iterable[BlurEvidence], options: GateOptions | None = None) -> RecordingVerdict:
    """Judge gyroscope, axes, clock offset and exposure by several frames at once.

    The median decides: a wrong axis still fits the frames in which it hardly rotates. Where single frames say too
    little, as short blurs do, all together decide, against what they say of a flipped axis. Where they do not bear the
    gyroscope out, what stands out of their quiet parts is asked again, each and all together.

    Parameters
    ----------
    evidence
        ``blur_evidence`` of some ten frames or more, among the more blurred of the recording.
    options
        Thresholds.
    """
    options = options or GateOptions()
    evidence = list(evidence)
    verdict = _judge_evidence(evidence, options)
    if verdict.trusted is False:
        # a sky hides what stands below it
        standing = [frame.standing for frame in evidence if frame.standing is not None]
        below = _judge_evidence(standing, options)
        if below.trusted and sum(standing, BlurEvidence.nothing()).support >= options.min_recording_support:
            return below
    return verdict


def _judge_evidence(evidence: Sequence[BlurEvidence], options: GateOptions) -> RecordingVerdict:
    telling = [frame for frame in evidence if frame.enough]
    supports = [_plausible_support(frame) for frame in telling]
    median = float(np.median(supports)) if supports else 0.0
    together = sum(telling, BlurEvidence.nothing())
    factor = _correct_extent(together)
    if len(telling) < GATE_LIMITS.fewest_frames:
        trusted, reason = None, Fact("too-few-blurred-frames", count=len(telling))
    elif median < options.min_recording_support and not _is_clear_together(telling, together):
        trusted = False
        reason = Fact("blur-not-shown", support_sigmas=median, count=len(telling))
    else:
        sigmas = max(median, together.support)
        trusted, reason = True, Fact("blur-confirmed", support_sigmas=sigmas, extent_factor=factor)
    return RecordingVerdict(trusted=trusted, support=median, extent_factor=factor, frames=len(telling), reason=reason)


def _is_clear_together(telling: Sequence[BlurEvidence], together: BlurEvidence) -> bool:
    """Whether many individually weak frames together confirm the gyroscope, and no flipped axis."""
    if (
        together.support - max(0.0, together.mirrored_support) < GATE_LIMITS.together_support
        or not together.extent_is_plausible
    ):
        return False
    votes = [
        frame.support - frame.mirrored_support
        for frame in telling
        if frame.support >= GATE_LIMITS.vote_support or frame.mirrored_support >= GATE_LIMITS.vote_support
    ]
    against = sum(vote < -1 for vote in votes)
    return len(votes) - against >= max(GATE_LIMITS.fewest_frames, 3 * against)


def _correct_extent(evidence: BlurEvidence) -> float:
    """The factor that the extents need."""
    factor = evidence.extent_factor
    clear = evidence.support >= GATE_LIMITS.clear_support and evidence.extent_is_plausible
    mean_px = evidence.extent_px / max(evidence.tiles, 1)
    drift = max(GATE_LIMITS.corrected_from, GATE_LIMITS.drift_px / mean_px if mean_px > 0 else 0.0)
    return factor if clear and abs(factor - 1) > drift else 1.0


def _plausible_support(evidence: BlurEvidence) -> float:
    return evidence.support if evidence.extent_is_plausible else min(evidence.support, 0.0)


def judge_frame(
    image: NDArray[Code],
    blur: BlurField,
    recording: RecordingVerdict | None,
    options: GateOptions,
    path: BlurPath | None = None,
) -> tuple[float | None, Fact]:
    """Whether an image confirms its blur.

    Parameters
    ----------
    image
        (H, W) or (H, W, 3), sRGB.
    blur
        Predicted by the gyroscope.
    recording
        What its frames say together (:func:`judge_recording`). Without it, only frames that show the blur clearly by
        themselves are deblurred.
    options
        Thresholds.
    path
        The curve of which ``blur`` is the chord, where it is known.

    Returns
    -------
    The factor for the extents, or ``None`` for a frame to leave alone; and why.
    """
    if recording is not None and recording.trusted is False:
        return None, recording.reason
    if is_blank(image):
        return None, Fact("frame-blank")
    unsure = blur.unsure_share()
    if unsure > GATE_LIMITS.most_unsure:
        return None, Fact("blur-uncertain", unsure_share=float(unsure))
    curve = BlurPath.straight(blur) if path is None else path
    if recording is not None and recording.trusted:
        share = measure_blur_share(image, curve.times(recording.extent_factor))
        if share is not None and share < GATE_LIMITS.least_share:
            return None, Fact("frame-sharp-along-blur")
        # a flat spectrum predicts no fall, and so tells none
        if (share is None or share < GATE_LIMITS.clear_share) and _lacks_dip(image, curve, options):
            return None, Fact("frame-without-blur")
        return recording.extent_factor, recording.reason
    evidence = blur_evidence(image, curve)
    own = _plausible_support(evidence) if evidence.enough else 0.0
    if not evidence.enough:
        return None, Fact("frame-not-telling")
    if own < options.min_support:
        return None, Fact("frame-blur-not-shown", support_sigmas=own, wanted_sigmas=options.min_support)
    return _correct_extent(evidence), Fact("frame-blur-confirmed", support_sigmas=own)


def _lacks_dip(image: NDArray[Code], curve: BlurPath, options: GateOptions) -> bool:
    """Whether blur that is long enough to show a dip shows none."""
    if float(np.percentile(curve.field().extent_px(), 90)) < GATE_LIMITS.must_show_px:
        return False
    evidence = blur_evidence(image, curve)
    return evidence.enough and _plausible_support(evidence) < options.min_recording_support


@dataclass(frozen=True, kw_only=True)
class SharpBlockLimits:
    """Limits for blocks of a deblurred frame that keep their original pixels (:func:`keep_sharp`)."""

    #: Side of the blocks that keep or give up their pixels together.
    block_px: int = 32
    #: Share of the blur length over which brightness is compared.
    span: float = 0.25
    #: A step smeared over L rises by no more than a quarter of its height within L / 4: from this many times that on,
    fade_from: float = 1.8
    #: the original fades in, up to this many times.
    fade_to: float = 2.6
    #: Least brightness range of a block, of full scale: below, there is nothing to lose.
    least_range: float = 0.06
    #: Shorter blur cannot be told.
    shortest_px: float = 5.0


_SHARP = SharpBlockLimits()


def keep_sharp(image: NDArray[Code], deblurred: NDArray[Code], blur: BlurField) -> tuple[NDArray[Code], float]:
    """Blend back to the original where it was too sharp to be blurred as predicted.

    Blur of length L lets brightness change by its whole local range only over L. A block where it changes by more than
    half of its range within a quarter of L along the blur was not blurred so: something that moved with the camera,
    a reflection, writing on the lens.

    Returns
    -------
    The blend, and the share of the image that stayed as it was.
    """
    import cv2

    height, width = image.shape[:2]
    rows, columns = -(-height // _SHARP.block_px), -(-width // _SHARP.block_px)
    # judged at half the size: a quarter of the cost, and of the noise
    size = (max(1, width // 2), max(1, height // 2))
    small = cv2.resize(convert_to_grey(image), size, interpolation=cv2.INTER_AREA).astype(np.float32)
    grey: Float32Array = np.asarray(cv2.GaussianBlur(small, (0, 0), 0.5) / np.float32(np.iinfo(image.dtype).max))
    nearest = [
        np.minimum(np.rint(np.arange(n) * 2 / blur.step_px).astype(np.intp), nodes - 1)
        for n, nodes in zip(size[::-1], blur.vector_px.shape, strict=False)
    ]
    along_x, along_y = (0.5 * blur.vector_px[..., i][nearest[0]][:, nearest[1]] for i in (0, 1))
    x, y = np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32)[:, None]
    half = 0.5 * _SHARP.span
    ends = [
        cv2.remap(grey, x + s * along_x, y + s * along_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        for s in (half, -half)
    ]
    change = np.asarray(np.abs(ends[0] - ends[1]), dtype=np.float32)
    side = _SHARP.block_px // 2

    def blocks(values: Float32Array, pick: Callable[..., Float32Array]) -> Float32Array:
        padded = cv2.copyMakeBorder(values, 0, rows * side - size[1], 0, columns * side - size[0], cv2.BORDER_REPLICATE)
        # lines first: whole rows at a time
        return pick(pick(padded.reshape(rows, side, -1), axis=1).reshape(rows, columns, side), axis=2)

    around = np.ones((3, 3), np.uint8)
    span = cv2.dilate(blocks(grey, np.max), around) - cv2.erode(blocks(grey, np.min), around)
    length = 2 * np.hypot(blocks(np.abs(along_x), np.max), blocks(np.abs(along_y), np.max))
    q = blocks(change, np.max) / (_SHARP.span * np.maximum(span, _SHARP.least_range))
    keep = np.clip((q - _SHARP.fade_from) / (_SHARP.fade_to - _SHARP.fade_from), 0, 1)
    keep[(span < _SHARP.least_range) | (length < _SHARP.shortest_px)] = 0
    share = float(keep.mean())
    if share == 0:
        return deblurred, 0.0
    whole = (columns * _SHARP.block_px, rows * _SHARP.block_px)
    weight = cv2.resize(keep.astype(np.float32), whole, interpolation=cv2.INTER_LINEAR)[:height, :width]
    out = deblurred.copy()
    for top in range(0, height, _SHARP.block_px):
        rows_px = slice(top, top + _SHARP.block_px)
        kept = np.flatnonzero(weight[rows_px].any(axis=0))
        if len(kept):
            band = rows_px, slice(kept[0], kept[-1] + 1)
            part = weight[band] if image.ndim == 2 else weight[band][..., None]
            out[band] = np.rint(deblurred[band] + part * (image[band].astype(np.float32) - deblurred[band]))
    return out, share
