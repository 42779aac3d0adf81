"""Compare some of the frames with the gyroscope, before any is treated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_inertial.core.arrays import AnyArray
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.progress import Progress, report_each
from colmap_inertial.imaging.evidence import BlurEvidence, blur_evidence, measure_blur_shares
from colmap_inertial.imaging.gate import (
    GATE_LIMITS,
    FrameDecision,
    GateOptions,
    RecordingVerdict,
    judge_recording,
)
from colmap_inertial.imaging.parallax import Parallax
from colmap_inertial.imaging.psf import blur_path
from colmap_inertial.imaging.tracking import convert_to_grey
from colmap_inertial.model import colmap_camera
from colmap_inertial.run.preparation.frame_reading import FullFrames
from colmap_inertial.run.stages.imaging_plan import GyroView


@dataclass(frozen=True, kw_only=True)
class JudgeLimits:
    """Limits for frames that confirm the gyroscope's blur."""

    #: A gyroscope that is confirmed by this share of the frames is trusted for all of them.
    trusted_share: float = 0.95
    #: Of frames that are mostly sky, this share: of the little below it, the fall of detail scatters by .2.
    trusted_share_of_skies: float = 0.85
    #: A frame whose dip is faint confirms the gyroscope, too, where detail falls along the blur as predicted, and no
    #: other direction shows a dip this deep.
    other_support: float = 4.0
    #: Images whose tiles tell no more than this share of them would if all were alike are mostly sky. Common ones
    #: with short blur are at .8; 70 % of sky leaves .6.
    standing_share: float = 0.7
    #: So many frames that are mostly sky confirm the gyroscope where so large a share of them shows the fall of
    #: detail, and they rather show it than the mirrored one by so many standard deviations of the mean. Right
    #: gyroscopes have .7 to 1 and 3.8 to 5.6, wrong ones .45 and 3.2 at most, not both at once.
    sky_frames: int = 5
    sky_share: float = 0.65
    sky_sigmas: float = 3.0
    #: Where the images do not confirm the gyroscope, exposure times may be wrong by a common factor; these are
    #: tried. Twice the blur shows a dip, too, where the right one shows a deeper one.
    exposure_factors: tuple[float, ...] = (0.5, 2.0)
    exposure_support: float = 10.0


_LIMITS = JudgeLimits()


def judge_frames(
    view: GyroView,
    frames: FullFrames,
    chosen: Sequence[FrameDecision],
    parallaxes: Mapping[str, Parallax],
    progress: Progress,
) -> RecordingVerdict:
    """Judge the gyroscope by some frames.

    Parameters
    ----------
    view
        Gyroscope, camera and times.
    frames
        The images.
    chosen
        The frames to look at, blurred ones.
    parallaxes
        By frame name, where the camera's translation is known to blur.
    progress
        Called with ``"blur"``.

    Returns
    -------
    Whether it is trusted for all frames, or every frame must confirm it by itself. Where the images confirm it but
    for exposure times that are wrong by one factor, that is corrected, and said.
    """

    decoded = frames.decode([decision.name for decision in chosen])
    # decoded once for every factor that is tried, and held in grey, which is all that is looked at
    pictures = {frame.name: convert_to_grey(frame.image) for frame in decoded}

    def look(factor: float) -> list[Looked]:
        return _look(view, pictures, chosen, parallaxes, progress, factor)

    looked = look(1.0)
    verdict = judged(looked)
    factors: tuple[float, ...] = _LIMITS.exposure_factors
    if verdict.trusted is True:
        long_blur = np.median([frame.blur_px for frame in looked]) >= 2 * GATE_LIMITS.must_show_px
        factors = tuple(factor for factor in factors if factor < 1 and long_blur)
    return _correct_exposures(verdict, looked, factors, look)


@dataclass(frozen=True, eq=False)
class Looked:
    """Evidence of one image: its dips, its share of the predicted loss of detail, that blur, and its share of the
    loss that a flipped axis would predict.
    """

    evidence: BlurEvidence
    share: float | None
    blur_px: float
    mirrored_share: float | None = None

    @property
    def shows(self) -> bool:
        """Whether it confirms the gyroscope."""
        evidence = self.evidence
        if (
            self.is_mostly_sky
            and self.gain >= GATE_LIMITS.least_share
            and (self.share or 0.0) >= GATE_LIMITS.least_share
        ):
            return True
        if not evidence.extent_is_plausible:
            return False
        other = float(evidence.sigmas[:, 2:-1].max())
        faint = self.share is not None and self.share >= GATE_LIMITS.least_share and other < _LIMITS.other_support
        return evidence.support >= GateOptions().min_support or faint

    @property
    def gain(self) -> float:
        """Evidence for the gyroscope's direction over the mirrored one."""
        return np.nan if self.share is None or self.mirrored_share is None else self.share - self.mirrored_share

    @property
    def is_mostly_sky(self) -> bool:
        """Whether the few parts that stand out of it would go down among the quiet ones."""
        standing = self.evidence.standing
        return standing is not None and standing.tiles < _LIMITS.standing_share * self.evidence.tiles


def _look(
    view: GyroView,
    pictures: Mapping[str, AnyArray],
    chosen: Sequence[FrameDecision],
    parallaxes: Mapping[str, Parallax],
    progress: Progress,
    factor: float,
) -> list[Looked]:
    """Evidence of some frames for the predicted blur, or a multiple of it."""
    motion, camera, index = view.motion(), colmap_camera(view.camera), view.index()
    blur_px = {decision.name: factor * (decision.blur_px or 0.0) for decision in chosen}
    looked: list[Looked] = []
    for name, picture in report_each(pictures.items(), len(chosen), "blur", progress):
        path = blur_path(motion, camera, view.shutter(index[name]), parallax=parallaxes.get(name), extent_factor=factor)
        share, mirrored = measure_blur_shares(picture, path)
        looked.append(Looked(blur_evidence(picture, path), share, blur_px[name], mirrored))
    return looked


def _correct_exposures(
    verdict: RecordingVerdict,
    looked: Sequence[Looked],
    factors: Sequence[float],
    look: Callable[[float], Sequence[Looked]],
) -> RecordingVerdict:
    """The verdict, or where all exposure times are wrong by one factor, that of the images with it corrected."""
    best, deepest = verdict, _together([frame.evidence for frame in looked])
    for factor in factors:
        others = look(factor)
        evidence = [frame.evidence for frame in others]
        corrected, support = judged(others), _together(evidence)
        if corrected.trusted is True and support >= _LIMITS.exposure_support and support > deepest:
            whole = factor * corrected.extent_factor
            reason = Fact("exposures-off-by-factor", support_sigmas=support, factor=whole)
            best, deepest = replace(corrected, extent_factor=whole, reason=reason), support
    return best


def _together(evidence: Sequence[BlurEvidence]) -> float:
    return sum(evidence, BlurEvidence.nothing()).support


def judged(looked: Sequence[Looked]) -> RecordingVerdict:
    """Joint evidence of frames, and whether nearly each of them confirms the blur."""
    return judge_each_frame(judge_sky(judge_recording([frame.evidence for frame in looked]), looked), looked)


def judge_sky(verdict: RecordingVerdict, looked: Sequence[Looked]) -> RecordingVerdict:
    """The verdict; or trust, where the frames are mostly sky and what stands below it falls off as it should."""
    gains = np.array([frame.gain for frame in looked if frame.is_mostly_sky and np.isfinite(frame.gain)])
    if verdict.trusted is not False or len(gains) < max(_LIMITS.sky_frames, len(looked) / 2):
        return verdict
    shown = sum(frame.is_mostly_sky and frame.shows for frame in looked)
    sigmas = float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-9))
    if shown < _LIMITS.sky_share * len(gains) or sigmas < _LIMITS.sky_sigmas:
        return verdict
    reason = Fact("blur-confirmed-below-sky", support_sigmas=sigmas)
    return replace(verdict, trusted=True, support=sigmas, extent_factor=1.0, reason=reason)


def judge_each_frame(verdict: RecordingVerdict, looked: Sequence[Looked]) -> RecordingVerdict:
    """The verdict; where only some of the frames confirm the blur, each frame must confirm it by itself.

    This happens where the camera moves close to objects: translation blurs them, too, and the gyroscope does not
    measure it.
    """
    telling = [frame for frame in looked if frame.evidence.enough and frame.blur_px >= GATE_LIMITS.must_show_px]
    shown = sum(frame.shows for frame in telling)
    skies = 2 * sum(frame.is_mostly_sky for frame in telling) > len(telling)
    most = _LIMITS.trusted_share_of_skies if skies else _LIMITS.trusted_share
    if verdict.trusted is not True or shown >= most * len(telling):
        return verdict
    reason = Fact("blur-confirmed-by-some", confirming=shown, count=len(telling))
    return replace(verdict, trusted=None, reason=reason)
