"""The ways to undo blur that ``scripts/benchmarks/path.py`` compares, by their names in the package, and their cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from colmap_inertial.core.arrays import UInt8Array
from colmap_inertial.core.types import Projector
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.evidence import blur_evidence
from colmap_inertial.imaging.gate import GateOptions, RecordingVerdict, judge_frame, judge_recording, keep_sharp
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.path_filters import DeblurOptions, half_quadratic, path_wiener, smoothed
from colmap_inertial.imaging.psf import blur_field, blur_path
from colmap_inertial.imaging.restoration import Network, deepgyro, load_network
from colmap_inertial.run.stages.deblur import SMOOTHING, smoothing_for
from scripts.common import imaging_metrics as metrics
from scripts.common.path_scenes import Known, Moment, Pair, Take, blur_px, shortened
from scripts.common.turning_world import TurningCamera

#: Costs are measured at these blurs, px, of a frame of this size.
COSTS_PX, COST_SIZE = (10.0, 20.0, 40.0), (1920, 1080)
#: Frames of 1920 px with less blur are left alone; one of which more stays as it was is not smoothed (`DeblurStage`).
LEAST_PX, MOSTLY_KEPT = 3.0, 0.5
#: As many frames judge a recording, the most blurred ones.
_JUDGED = 14
_ONE = DeblurOptions(threads=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Made:
    """A frame as features see it, and as people do."""

    for_features: UInt8Array
    for_people: UInt8Array


def _both(image: UInt8Array, blur: BlurField) -> Made:
    return Made(for_features=smoothed(image, _width_px(blur)), for_people=image)


def _width_px(blur: BlurField) -> float:
    return smoothing_for(float(np.percentile(blur.extent_px(), 90)))


@cache
def _network() -> Network:
    return load_network("deepgyro", device="cpu", threads=1)


def _smoothed_alone(image: UInt8Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter) -> Made:
    return _both(image, blur_field(motion, camera, shutter))


def _wiener(image: UInt8Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter) -> Made:
    path = blur_path(motion, camera, shutter)
    return _both(path_wiener(image, path, _ONE), path.field())


def _path(image: UInt8Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter) -> Made:
    path = blur_path(motion, camera, shutter)
    return _both(half_quadratic(image, path, _ONE), path.field())


def _deepgyro(image: UInt8Array, motion: GyroCamera, camera: Projector, shutter: FrameShutter) -> Made:
    path = blur_path(motion, camera, shutter)
    return _both(deepgyro.deblur(image, path, network=_network()), path.field())


#: ``untreated, smoothed`` is the frame without any filter.
METHODS: Mapping[str, Callable[..., Made]] = {
    "untreated, smoothed": _smoothed_alone,
    "wiener": _wiener,
    "path": _path,
    "deepgyro": _deepgyro,
}


# --- the gate ---------------------------------------------------------------------------------------------------------


def gate(takes: Sequence[Take], binned: Callable[[float], str], *, console: Console) -> dict[str, Any]:
    """Share of truly blurred frames that are treated, and matches that sharp ones keep, for each exposure time."""
    out: dict[str, Any] = {}
    for take in takes:
        label = f"{1e3 * take.exposure_s:g} ms"
        blurred = [(pair, i) for pair in take.pairs for i in (0, 1)]
        known = [pair.known(i, "exact") for pair, i in blurred]
        fields = [_field(one) for one in known]
        trusted = verdict_on([pair.frame(i) for pair, i in blurred], known)
        row: dict[str, Any] = {"verdict": str(trusted.reason), "trusted": trusted.trusted, "treated": {}}
        of_each = list(zip(blurred, fields, known, strict=True))
        for (pair, i), field, motion in track(of_each, f"gate, {label}", console=console):
            factor, _ = judge_frame(pair.frame(i), field, trusted, GateOptions(), blur_path(*motion))
            one = row["treated"].setdefault(binned(pair.blur_px), {"frames": 0, "treated": 0})
            one["frames"] += 1
            one["treated"] += int(factor is not None)
        sharp = [pair.short(i) for pair, i in blurred]
        # as a wrong exposure time has it: alone, and among frames that confirm the gyroscope; and as it is
        row["sharp recording"] = _kept(take.pairs, known, verdict_on(sharp, known))
        row["sharp among blurred"] = _kept(take.pairs, known, trusted)
        brief = [pair.known(i, "exact", shortened(pair.moments[i])) for pair, i in blurred]
        row["sharp video"] = _kept(take.pairs, brief, verdict_on(sharp, brief))
        out[label] = row
    return out


def _field(known: Known) -> BlurField:
    return blur_field(*known)


def verdict_on(frames: Sequence[UInt8Array], known: Sequence[Known]) -> RecordingVerdict:
    fields = [_field(one) for one in known]
    order = sorted(range(len(frames)), key=lambda i: -float(np.percentile(fields[i].extent_px(), 90)))[:_JUDGED]
    return judge_recording(blur_evidence(frames[i], blur_path(*known[i])) for i in order)


def _kept(pairs: Sequence[Pair], known: Sequence[Known], verdict: RecordingVerdict) -> dict[str, Any]:
    """Correct matches of sharp frames through the gate, against those of doing nothing."""
    before = after = treated = 0
    for k, pair in enumerate(pairs):
        frames = [pair.short(i) for i in (0, 1)]
        gated = [_gated(frame, known[2 * k + i], verdict) for i, frame in enumerate(frames)]
        treated += sum(one is not None for one in gated)
        alone = pair.correct_matches(*(metrics.extract(frame, 0) for frame in frames))[0]
        before += alone
        if any(one is not None for one in gated):
            seen = [frame if one is None else one for frame, one in zip(frames, gated, strict=True)]
            after += pair.correct_matches(*(metrics.extract(image, 0) for image in seen))[0]
        else:
            after += alone
    return {"kept": after / max(before, 1), "treated": treated, "frames": 2 * len(pairs), "trusted": verdict.trusted}


def _gated(image: UInt8Array, known: Known, verdict: RecordingVerdict) -> UInt8Array | None:
    """What features see of a frame that goes through the gate, as ``DeblurStage`` has it; ``None`` as it was."""
    field = _field(known)
    factor, _ = judge_frame(image, field, verdict, GateOptions(), blur_path(*known))
    # the package leaves frames with less blur alone, before any picture is asked
    if factor is None or float(np.percentile(field.extent_px(), 90)) < LEAST_PX * image.shape[1] / 1920:
        return None
    scaled = field.times(factor)
    out, kept = keep_sharp(image, path_wiener(image, blur_path(*known, extent_factor=factor), _ONE), scaled)
    return smoothed(out, _width_px(scaled)) if kept < MOSTLY_KEPT else out


# --- cost -------------------------------------------------------------------------------------------------------------


def cost(take: Take, methods: Sequence[str], repeat: int = 5) -> dict[str, Any]:
    """Processor time of one thread, ms, of a grey 1080p frame; ratios to Wiener's filter."""
    camera = replace(take.pairs[0].camera, size=COST_SIZE, focal_px=1.5 * take.pairs[0].camera.focal_px)
    out: dict[str, Any] = {}
    for wanted_px in COSTS_PX:
        moment = with_blur(camera, take.pairs[0].moments[0], wanted_px)
        facing = replace(camera, wall_from_world=camera.facing(moment))
        pair = Pair(camera=facing, moments=(moment, moment), blur_px=wanted_px, seed=1, cache=None)
        image, known = pair.frame(0), pair.known(0, "exact")
        path = blur_path(*known)
        works: dict[str, Callable[[], object]] = {
            "wiener": lambda image=image, path=path: path_wiener(image, path, _ONE),
            "path": lambda image=image, path=path: half_quadratic(image, path, _ONE),
            "deepgyro": lambda image=image, path=path: deepgyro.deblur(image, path, network=_network()),
        }
        ms = {"smoothing": _least_ms(lambda image=image: smoothed(image, SMOOTHING.most_px), repeat)}
        ms |= {name: _least_ms(work, repeat) for name, work in works.items() if name in ("wiener", *methods)}
        ms["finding the path"] = _least_ms(lambda known=known: blur_path(*known), repeat)
        out[f"{wanted_px:g}"] = {
            "ms": ms,
            "times_wiener": {name: value / ms["wiener"] for name, value in ms.items()},
            "departure_px": path.departure_px(),
        }
    return out


def with_blur(camera: TurningCamera, moment: Moment, wanted_px: float) -> Moment:
    """The exposure, around the same instant, that blurs so much."""
    middle_s = moment.t_s + 0.5 * moment.exposure_s
    for _ in range(6):
        exposure_s = moment.exposure_s * wanted_px / max(blur_px(camera, moment), 1e-3)
        moment = replace(moment, exposure_s=exposure_s, t_s=middle_s - 0.5 * exposure_s)
    return moment


def _least_ms(run: Callable[[], object], repeat: int) -> float:
    found = []
    for _ in range(repeat):
        begin = time.process_time()
        run()
        found.append(1e3 * (time.process_time() - begin))
        if sum(found) > 2e4:
            break
    return min(found)
