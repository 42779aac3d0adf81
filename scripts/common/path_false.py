"""Recordings that are mostly sky, and gyroscopes that are wrong: what the gate trusts, and what is left of the matches.

For ``scripts.benchmarks.path --only sky false short``. Exposures are as long as the blur takes, along the recording's
own turns. Above a horizon there may be a sky: bright, with a gradient and soft clouds, noise and JPEG as everywhere;
what stands below it lies in its own shadow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import Float32Array, UInt8Array
from colmap_inertial.core.types import Frame, FrameTiming
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.evidence import blur_evidence, measure_blur_shares
from colmap_inertial.imaging.gate import GateOptions, RecordingVerdict, judge_frame, keep_sharp
from colmap_inertial.imaging.path_filters import smoothed
from colmap_inertial.imaging.psf import blur_field, blur_path
from colmap_inertial.motion.flow import measure_rotation, reduce_frames
from colmap_inertial.motion.sign import SignCheck, compare_signs
from colmap_inertial.run.preparation.blur_check import Looked, judged
from colmap_inertial.run.stages import deblur
from colmap_inertial.run.stages.deblur import smoothing_for
from scripts.common import imaging_metrics as metrics
from scripts.common.imaging_scenes import photographed_walls
from scripts.common.path_methods import LEAST_PX, METHODS, MOSTLY_KEPT, Made, with_blur
from scripts.common.path_scenes import FOCAL, HELD_OUT, INTERVAL_S, READOUT_S, Known, Pair, blur_px
from scripts.common.turning_world import Moment, Turning, TurningCamera
from scripts.restoration.photographs import photographs

#: Shares of the picture that are sky, blurs, and the blurs at which gyroscopes are wrong, px.
SKIES, SKY_PX, FALSE_PX = (0.7, 0.9), (6.0, 10.0), (10.0, 20.0)
#: Little blur, px, of small pictures: `GateOptions.skip_below_own_px` lies among these.
SHORT_PX, SMALL = (1.0, 1.5, 2.0, 3.0), (640, 360)
#: Light below a sky, as a share of what it would be without.
_SHADOW = 0.35
#: Seconds between pairs; slower turns would take longer exposures.
_EVERY_S, _LONGEST_S = 1.7, 0.066
_NOISE_RAD_S = 0.14


def _flipped(turning: Turning) -> Turning:
    return replace(turning, rate_rad_s=turning.rate_rad_s * [-1, 1, 1])


def _noisy(turning: Turning) -> Turning:
    noise = np.random.default_rng(3).standard_normal(turning.rate_rad_s.shape)
    return replace(turning, rate_rad_s=turning.rate_rad_s + _NOISE_RAD_S * noise)


def _backwards(turning: Turning) -> Turning:
    t_s = turning.t_s
    return replace(turning, t_s=t_s[0] + t_s[-1] - t_s[::-1], rate_rad_s=turning.rate_rad_s[::-1])


def _negative(turning: Turning) -> Turning:
    return replace(turning, rate_rad_s=-turning.rate_rad_s)


#: What is wrong of gyroscopes. White noise of 0.01 rad/s/sqrt(Hz) is thirty times a phone's.
WRONG: Mapping[str, Callable[[Turning], Turning]] = {
    "flipped axis": _flipped,
    "noise": _noisy,
    "backwards": _backwards,
    "sign": _negative,
    "backwards, sign": lambda turning: _negative(_backwards(turning)),
}


def judge_sky(wall: Float32Array, height: int, share: float, seed: int) -> Float32Array:
    """The wall with a horizon so high that this share of a frame of this height is sky."""
    horizon = round(0.5 * wall.shape[0] + (share - 0.5) * height)
    clouds = np.random.default_rng([seed, 31]).standard_normal((6, 9)).astype(np.float32)
    clouds = np.asarray(cv2.resize(clouds, wall.shape[1::-1], interpolation=cv2.INTER_CUBIC))
    sky = np.clip(np.linspace(0.45, 0.8, len(wall), dtype=np.float32)[:, None] + 0.03 * clouds, 0.05, 0.95)
    return np.where(np.arange(len(wall))[:, None] < horizon, sky, np.float32(_SHADOW) * wall)


def recording(
    photos: Path,
    motion: Path | None,
    wanted_px: float,
    *,
    count: int,
    size: tuple[int, int],
    sky: float = 0.0,
    seed: int = 0,
    cache: Path | None = None,
) -> list[Pair]:
    """So many pairs of frames with this blur each, one after the other; those that would take too long are passed."""
    turning = Turning.simulated(seed) if motion is None else Turning.recorded(motion, HELD_OUT)
    walls = photographed_walls(photographs(photos, held_out=True), 4, seed)
    found: list[Pair] = []
    for i, t_s in enumerate(np.arange(turning.t_s[0] + 1.0, turning.t_s[-1] - 2.0, _EVERY_S)):
        if len(found) == count:
            break
        moments = [Moment(t_s=float(t_s + k * INTERVAL_S), exposure_s=0.016, readout_s=READOUT_S) for k in (0, 1)]
        wall = walls[i % len(walls)]
        if sky > 0:
            wall = judge_sky(wall, size[1], sky, seed + i)
        camera = TurningCamera(
            wall=wall, wall_from_world=np.eye(3), turning=turning, size=size, focal_px=FOCAL * size[0]
        )
        camera = replace(camera, wall_from_world=camera.facing(*moments))
        if min(blur_px(camera, moment) for moment in moments) < 0.016 / _LONGEST_S * wanted_px:
            continue
        first, second = (with_blur(camera, moment, wanted_px) for moment in moments)
        camera = replace(camera, wall_from_world=camera.facing(first, second))
        found.append(Pair(camera=camera, moments=(first, second), blur_px=wanted_px, seed=1000 * seed + i, cache=cache))
    return found


def known_by(pair: Pair, index: int, wrong: Callable[[Turning], Turning] | None = None) -> Known:
    """What the package is told of a frame's motion, by a gyroscope that may be wrong."""
    if wrong is None:
        return pair.known(index, "exact")
    camera = replace(pair.camera, turning=wrong(pair.camera.turning))
    return replace(pair, camera=camera).known(index, "exact")


def judgement(frames: Sequence[UInt8Array], known: Sequence[Known]) -> RecordingVerdict:
    """What the pipeline says of a recording of pairs of neighbours: of its gyroscope's sign, and of its blur."""
    sign = _sign(frames, known)
    if sign.right is False:
        return RecordingVerdict(trusted=False, support=0.0, extent_factor=1.0, frames=len(frames), reason=sign.reason)
    looked = []
    for frame, one in zip(frames, known, strict=True):
        path = blur_path(*one)
        share, mirrored = measure_blur_shares(frame, path)
        looked.append(Looked(blur_evidence(frame, path), share, _length_px(path.field()), mirrored))
    return judged(looked)


def _sign(frames: Sequence[UInt8Array], known: Sequence[Known]) -> SignCheck:
    found = []
    for first, second, (motion, camera, one), (_, _, other) in zip(
        frames[::2], frames[1::2], known[::2], known[1::2], strict=True
    ):
        timing = FrameTiming(names=("0", "1"), t_s=np.array([one.t_s, other.t_s]), readout_s=one.readout_s)
        pair = (Frame(name=str(i), image=image, t_s=0.0) for i, image in enumerate((first, second)))
        rotation = measure_rotation(reduce_frames(pair), camera, timing)
        times_s = np.array([shutter.reference_s() for shutter in (one, other)])
        found.append((rotation.turn_rad[0], motion.turn_rad(times_s)[0], rotation.sigma_rad[0]))
    visual, inertial, sigma = (np.array(values) for values in zip(*found, strict=True))
    seen = np.isfinite(visual).all(axis=1)
    return compare_signs(visual[seen], inertial[seen], sigma[seen])


def options_for(verdict: RecordingVerdict, method: str) -> GateOptions:
    """The pipeline's: where a recording is not trusted in all, each frame must be clear by itself."""
    return GateOptions() if verdict.trusted else GateOptions(min_support=deblur._CLEAR_SUPPORT[method])


def gated(image: UInt8Array, known: Known, verdict: RecordingVerdict, method: str) -> Made | None:
    """What becomes of a frame that goes through the gate, as ``DeblurStage`` has it; ``None`` as it was."""
    factor, _ = judge_frame(image, blur_field(*known), verdict, options_for(verdict, method), blur_path(*known))
    if factor is None:
        return None
    motion, camera, shutter = known
    exposure_s = factor * (shutter.exposure_s or 0.0)
    shutter = replace(shutter, exposure_s=exposure_s, t_s=shutter.t_s + 0.5 * (exposure_s / factor - exposure_s))
    field = blur_field(motion, camera, shutter)
    if _length_px(field) < LEAST_PX * image.shape[1] / 1920:
        return None
    out, kept = keep_sharp(image, METHODS[method](image, motion, camera, shutter).for_people, field)
    seen = smoothed(out, smoothing_for(_length_px(field))) if kept < MOSTLY_KEPT else out
    return Made(for_features=seen, for_people=out)


def _length_px(field: BlurField) -> float:
    return float(np.percentile(field.extent_px(), 90))


def mostly_sky(make: Callable[..., list[Pair]], *, console: Console) -> list[dict[str, Any]]:
    """Of each recording and gyroscope: whether it is trusted, and how many frames are treated."""
    rows = []
    for blur, sky in [(blur, sky) for blur in SKY_PX for sky in (0.0, *SKIES)]:
        pairs = make(blur, sky=sky)
        places = [(pair, i) for pair in pairs for i in (0, 1)]
        frames = [pair.frame(i) for pair, i in places]
        right = [known_by(pair, i) for pair, i in places]
        wrong = {name: [known_by(pair, i, way) for pair, i in places] for name, way in WRONG.items()}
        short = [pair.short(i) for pair, i in places]
        ways = {"right": (frames, right), "sharp": (short, right), **{name: (frames, k) for name, k in wrong.items()}}
        for name, (images, known) in track(list(ways.items()), f"{blur:g} px, sky {sky:.0%}", console=console):
            verdict = judgement(images, known)
            treated = sum(
                judge_frame(image, blur_field(*one), verdict, options_for(verdict, "wiener"), blur_path(*one))[0]
                is not None
                for image, one in zip(images, known, strict=True)
            )
            rows.append(
                {
                    "blur_px": blur,
                    "sky": sky,
                    "gyroscope": name,
                    "trusted": verdict.trusted,
                    "support": verdict.support,
                    "treated": treated,
                    "frames": len(frames),
                }
            )
    return rows


def false_gyroscopes(
    make: Callable[..., list[Pair]], methods: Sequence[str], *, console: Console
) -> list[dict[str, Any]]:
    """Of each gyroscope and method: share of the correct matches of doing nothing that the gate leaves."""
    rows = []
    for blur in FALSE_PX:
        pairs = make(blur)
        frames = {"as filmed": [[pair.frame(i) for i in (0, 1)] for pair in pairs]}
        frames["sharp"] = [[pair.short(i) for i in (0, 1)] for pair in pairs]
        before = {
            name: [pair.correct_matches(*map(_features, two))[0] for pair, two in zip(pairs, shots, strict=True)]
            for name, shots in frames.items()
        }
        for name in track(("right", "sharp", *WRONG), f"{blur:g} px", console=console):
            shot = "sharp" if name == "sharp" else "as filmed"
            known = [[known_by(pair, i, WRONG.get(name)) for i in (0, 1)] for pair in pairs]
            verdict = judgement([image for two in frames[shot] for image in two], [one for two in known for one in two])
            for method in methods:
                after = treated = 0
                gained_db = []
                for pair, images, two, alone in zip(pairs, frames[shot], known, before[shot], strict=True):
                    made = [gated(image, one, verdict, method) for image, one in zip(images, two, strict=True)]
                    treated += sum(one is not None for one in made)
                    seen = [image if one is None else one.for_features for image, one in zip(images, made, strict=True)]
                    if shot != "sharp":
                        gained_db += _gained_db(pair, images, made)
                    changed = any(one is not None for one in made)
                    after += pair.correct_matches(*map(_features, seen))[0] if changed else alone
                rows.append(
                    {
                        "blur_px": blur,
                        "gyroscope": name,
                        "method": method,
                        "trusted": verdict.trusted,
                        "kept": after / max(sum(before[shot]), 1),
                        "gained_db": float(np.mean(gained_db)) if gained_db else 0.0,
                        "worst_db": min(gained_db, default=0.0),
                        "treated": treated,
                        "frames": 2 * len(pairs),
                    }
                )
    return rows


def _gained_db(pair: Pair, images: Sequence[UInt8Array], made: Sequence[Made | None]) -> list[float]:
    """PSNR that the treated ones gain."""
    return [
        metrics.psnr_db(one.for_people, pair.sharp(i)) - metrics.psnr_db(image, pair.sharp(i))
        for i, (image, one) in enumerate(zip(images, made, strict=True))
        if one is not None
    ]


def _features(image: UInt8Array) -> metrics.Features:
    return metrics.extract(image, 0)


def short_blur(make: Callable[..., list[Pair]], methods: Sequence[str], *, console: Console) -> list[dict[str, Any]]:
    """Small pictures with little blur, treated whatever the gate would say: correct matches and PSNR, before and after.

    The gyroscope is right, or wrong in the three ways of ``quality``.
    """
    rows = []
    for blur in track(SHORT_PX, "little blur", console=console):
        pairs = make(blur, size=SMALL)
        frames = [[pair.frame(i) for i in (0, 1)] for pair in pairs]
        sharp = [[pair.sharp(i) for i in (0, 1)] for pair in pairs]
        before = _matches(pairs, frames)
        before_db = _psnr_db(frames, sharp)
        for gyro in ("exact", "errors"):
            for method in methods:
                made = [
                    [METHODS[method](image, *pair.known(i, gyro)) for i, image in enumerate(two)]
                    for pair, two in zip(pairs, frames, strict=True)
                ]
                rows.append(
                    {
                        "blur_px": blur,
                        "gyroscope": gyro,
                        "method": method,
                        "untreated": before,
                        "ratio": _matches(pairs, [[m.for_features for m in two] for two in made]) / max(before, 1),
                        "gained_db": _psnr_db([[m.for_people for m in two] for two in made], sharp) - before_db,
                    }
                )
    return rows


def _matches(pairs: Sequence[Pair], frames: Sequence[Sequence[UInt8Array]]) -> int:
    return sum(pair.correct_matches(*map(_features, two))[0] for pair, two in zip(pairs, frames, strict=True))


def _psnr_db(frames: Sequence[Sequence[UInt8Array]], sharp: Sequence[Sequence[UInt8Array]]) -> float:
    each = [metrics.psnr_db(a, b) for two in zip(frames, sharp, strict=True) for a, b in zip(*two, strict=True)]
    return float(np.mean(each))
