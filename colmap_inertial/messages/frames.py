"""Words on frames: which are used, what is done to them, and why."""

from __future__ import annotations

from colmap_inertial.messages import Said, message, state

# blur before a frame is decoded

state(
    "exposure-unknown",
    "the exposure time is unknown (the images carry none); give exposure_s under [timing] in capture.toml, or a column "
    "of it in the frame times",
)
state("blur-unknown", "the blur of this frame is unknown")
state("exposure-not-covered", "the gyroscope does not cover the exposure of this frame, or pauses in it")


@message(example={"blur_px": 12.3})
def blur_px(blur_px: float) -> str:
    return f"{blur_px:.1f} px of blur"


@message(example={"blur_px": 1.2})
def blur_too_short(blur_px: float) -> str:
    return f"{blur_px:.1f} px of blur, too little to matter"


@message(example={"blur_px": 61.0})
def blur_too_long(blur_px: float) -> str:
    return f"{blur_px:.0f} px of blur, too much, and neighbouring frames are sharper"


@message(example={"blur_px": 61.0})
def blur_bridges_gap(blur_px: float) -> str:
    return f"{blur_px:.0f} px of blur, too much, but kept as it bridges a gap"


@message(example={"blur_px": 61.0})
def blur_at_end(blur_px: float) -> str:
    return f"{blur_px:.0f} px of blur, too much, but kept as the last frame"


@message(example={"blur_px": 140.0})
def blur_not_undone(blur_px: float) -> str:
    return f"{blur_px:.0f} px of blur, too long to deblur"


# what the images say about the gyroscope


@message(example={"count": 2})
def too_few_blurred_frames(count: int) -> str:
    return f"{count} frames are too few to check the gyroscope against the images"


@message(example={"support_sigmas": 0.4, "count": 12})
def blur_not_shown(support_sigmas: float, count: int) -> str:
    return (
        f"the images do not show the blur that the gyroscope predicts ({support_sigmas:.1f} standard deviations in the "
        f"median of {count} frames): check its axes, the clock offset, the exposure times, and that the "
        "video was not stabilised"
    )


@message(example={"support_sigmas": 9.0, "extent_factor": 0.8})
def blur_confirmed(support_sigmas: float, extent_factor: float = 1.0) -> str:
    confirmed = f"the images confirm the gyroscope's blur ({support_sigmas:.0f} standard deviations)"
    if extent_factor == 1.0:
        return confirmed
    return f"{confirmed}, with its extent multiplied by {extent_factor:.2f}"


@message(example={"support_sigmas": 12.0, "factor": 2.0})
def exposures_off_by_factor(support_sigmas: float, factor: float) -> str:
    return f"{blur_confirmed(support_sigmas, factor)}: the exposure times are off by this factor"


@message(example={"support_sigmas": 4.0})
def blur_confirmed_below_sky(support_sigmas: float) -> str:
    return f"the images confirm the gyroscope's blur below the sky ({support_sigmas:.0f} standard deviations)"


@message(example={"confirming": 8, "count": 12})
def blur_confirmed_by_some(confirming: int, count: int) -> str:
    return (
        f"{confirming} of {count} examined frames confirm the gyroscope's blur, so each frame must confirm it "
        "by itself (close to objects, the camera's translation also blurs)"
    )


@message(example={"unsure_share": 0.3})
def blur_uncertain(unsure_share: float) -> str:
    return f"the blur's length is uncertain by {unsure_share:.0%} (gyroscope noise and calibration)"


state(
    "frame-sharp-along-blur",
    "the image has as much detail along the predicted blur as across it, though other frames lack it",
)
state("frame-blank", "the image is black or without texture: nothing to deblur")
state("frame-without-blur", "the image does not show the blur that the gyroscope predicts, though other frames do")
state("frame-not-telling", "too little texture or blur to check the gyroscope's prediction")


@message(example={"support_sigmas": 1.2, "wanted_sigmas": 4.0})
def frame_blur_not_shown(support_sigmas: float, wanted_sigmas: float) -> str:
    return (
        f"the image does not show the blur that the gyroscope predicts ({support_sigmas:.1f} standard deviations, "
        f"{wanted_sigmas:g} needed)"
    )


@message(example={"support_sigmas": 6.0})
def frame_blur_confirmed(support_sigmas: float) -> str:
    return f"the image confirms the gyroscope's blur ({support_sigmas:.0f} standard deviations)"


# stages


@message(example={"doubt": "40 pairs of frames do not show whether the gyroscope has the right sign"})
def curved_blur_in_doubt(doubt: Said) -> str:
    return f"{doubt}, and the opposite sign would curve the blur the other way"


state("readout-not-covered", "the gyroscope does not cover the whole readout")
state("frame-readout-not-covered", "the gyroscope does not cover the readout of this frame, or pauses in it")
state("shutter-undone", "corrected by the gyroscope")


@message(example={"count": 4})
def apertures_fused(count: int) -> str:
    return f"fused from {count} sub-images"


@message(example={"action": "changed"})
def by_a_stage(action: str) -> str:
    return f"{action} by a stage"


# short and long exposures

state("no-gyroscope", "no gyroscope")
state("pair-exposure-unknown", "an exposure time is unknown")
state("pair-not-covered", "the gyroscope does not cover the time between the two exposures, or pauses in it")
state("frames-without-times", "the frames have no times")
state("pair-rotation-not-confirmed", "the images do not confirm the gyroscope's rotation")
state(
    "pair-gain-unknown",
    "too few pixels are neither black in the short nor clipped in the long exposure; give the exposure "
    "times and sensitivities",
)
state(
    "short-exposure-unknown",
    "the short exposures' time is unknown; give exposure_s under [timing] in capture.toml, or a column of "
    "it in the frame times",
)
state(
    "long-exposure-unknown",
    "start or length of the long exposures is unknown; give times with a column exposure_s, or long_delay_s "
    "and long_exposure_s, under [exposures] in capture.toml",
)


@message(
    example={
        "long": "0001_long.png",
        "gain": 8.0,
        "by_gyro": True,
        "by_pixels": True,
        "no_gyro": None,
        "contradicted_gain": 4.0,
    }
)
def exposures_fused(
    long: str, gain: float, by_gyro: bool, by_pixels: bool, no_gyro: Said | None, contradicted_gain: float | None
) -> str:
    by = [name for name, used in (("the gyroscope", by_gyro), ("the pixels", by_pixels)) if used]
    aligned = f"aligned by {' and '.join(by)}" if by else "not aligned: no shift improves the match"
    description = f"fused with {long}, which is {gain:.3g} times as bright; {aligned}"
    if no_gyro is not None:
        description += f" ({no_gyro})"
    if contradicted_gain is not None:
        description += (
            f"; exposure times and sensitivities give {contradicted_gain:.3g} times, which the pixels contradict"
        )
    return description


@message(example={"long": "0001_long.png", "correlation": 0.12})
def pair_not_alike(long: str, correlation: float) -> str:
    return f"{long} shows something else (correlation {correlation:.2f})"


@message(example={"used": "short", "gain": 6.0, "why": "0001_long.png does not show the same (correlation 0.12)"})
def exposures_not_fused(used: str, gain: float, why: Said) -> str:
    what = "the long exposure as it is" if used == "long" else f"the short exposure, {gain:.3g} times as bright"
    return f"is {what}, not fused: {why}"


@message(example={"no_gyro": None})
def exposures_aligned(no_gyro: Said | None) -> str:
    return "short and long exposures are fused, aligned by the " + (
        "gyroscope and the pixels" if no_gyro is None else f"pixels alone: {no_gyro}"
    )


# the plan of a recording

state("left-to-frame-stages", "left to the given frame stages")
state("left-to-keypoint-stages", "left to the given keypoint stages")
state("not-asked-for", "switched off")
state("rig-not-deblurred", "frames are not deblurred: not supported for a rig's cameras")
state(
    "no-exposures-to-deblur",
    "frames are not deblurred: the exposure time is unknown; give exposure_s under [timing] in "
    "capture.toml, or a column of it in the frame times",
)
state("rig-not-rectified", "keypoints of a rig's cameras are not rectified")
state(
    "rectifying-without-readout",
    "the readout is unknown: give readout_s under [timing] in capture.toml (see docs/devices)",
)
state("global-shutter", "global shutter")


@message(example={"why": "the pixels' motion is not observable: the video was stabilised"})
def frames_untreated(why: Said) -> str:
    return f"frames are not deblurred: {why}"


@message(example={"most_px": 1.4, "by_sliding": True})
def blur_nowhere(most_px: float, by_sliding: bool) -> str:
    why_not = f"no frame has more than {most_px:.1f} px of blur by the fastest measured rotation"
    return f"{why_not} and the optical flow between frames" if by_sliding else why_not


@message(example={"most_px": 2.1})
def blur_predicted_nowhere(most_px: float | None) -> str:
    most = "nothing" if most_px is None else f"{most_px:.1f} px"
    return f"frames are not deblurred: the gyroscope predicts {most} of blur"


#: What the note says of methods other than the default.
_METHODS = {"deepgyro": "; deblurred by the network DeepGyro", "path": "; deblurred by the half-quadratic filter"}


@message(
    example={
        "blurred": 40,
        "frames": 120,
        "verdict": "the images confirm the gyroscope's blur (9 standard deviations)",
        "with_translation": 12,
        "sign_doubt": None,
        "method": "path",
    }
)
def frames_blurred(
    blurred: int, frames: int, verdict: Said, with_translation: int, sign_doubt: Said | None, method: str | None
) -> str:
    note = f"{blurred} of {frames} frames are blurred; {verdict}"
    if with_translation:
        note += f"; the camera's translation is included for {with_translation} frames"
    if sign_doubt is not None:
        note += f"; {sign_doubt}, so frames with curved blur are not deblurred"
    return note + _METHODS.get(method or "", "")


@message(example={"readout_s": 0.02, "source": "the camera's data sheet"})
def keypoints_rectified(readout_s: float, source: str) -> str:
    return f"keypoints are rectified, readout {1e3 * readout_s:.1f} ms{f' ({source})' if source else ''}"


@message(example={"planned": "left to the given keypoint stages", "count": 90})
def keypoints_rectified_by_stages(planned: Said | None, count: int) -> str:
    return f"{planned or ''}, which rectified keypoints of {count} images"


state("keypoints-not-covered", "no keypoints are rectified: the gyroscope covers no image's whole readout")

# camera and gyroscope before the reconstruction


@message(example={"focal_px": 1500.0})
def focal_length_guessed(focal_px: float) -> str:
    return f"the focal length was guessed: {focal_px:.0f} px"


@message(example={"quantity": "clock offset", "why": "the camera hardly turns", "sigma": None})
def quantity_not_observable(quantity: str, why: Said | str, sigma: float | None) -> str:
    spread = "" if sigma is None else f" (standard deviation {100 * sigma:.1f} %)"
    return f"{quantity} is not observable{spread}: {why if isinstance(why, str) else why.with_advice}"


# the frames that are used

state("all-frames-asked", "all frames, as requested")
state("all-pictures", "all images of the folder")
state("frames-as-capture-says", "as set by frames_per_s in capture.toml")
state("one-clock", "the recorder timestamped frames and gyroscope with one clock")

_RANKS = {"blur": "predicted blur", "speed": "angular speed", "sharpness": "sharpness"}


@message(example={"sigma_s": 0.005})
def offset_of_capture(sigma_s: float) -> str:
    return f"the time offset is that of the capture (to {1e3 * sigma_s:.0f} ms)"


@message(example={"why": "clock offset is not observable: the camera hardly turns"})
def offset_unknown_beforehand(why: Said) -> str:
    return f"the time offset is not known beforehand: {why}"


@message(example={"sigma_s": 0.0012, "rate": 2e-5, "rate_sigma": 4e-6})
def offset_by_pixels(sigma_s: float, rate: float | None, rate_sigma: float) -> str:
    rates = "" if rate is None else f", and clock rates differ by {1e6 * rate:+.0f} ppm (to {1e6 * rate_sigma:.0f} ppm)"
    return f"the time offset was found from optical flow, to {1e3 * sigma_s:.1f} ms{rates}"


@message(
    example={
        "used": 120,
        "frames": 900,
        "ranked_by": ("blur",),
        "clocks": "the time offset is that of the capture (to 5 ms)",
    }
)
def frames_selected(used: int, frames: int, ranked_by: tuple[str, ...], clocks: Said) -> str:
    return f"{used} of {frames} frames, by {' and '.join(_RANKS[way] for way in ranked_by)}; {clocks}"


# frames in no model


@message(example={"features": 4})
def image_without_features(features: int) -> str:
    return f"it is in no model: it has only {features} features (black, blurred or without texture)"


@message(example={"features": 900})
def image_without_matches(features: int) -> str:
    return f"it is in no model: none of its {features} features match an image of a model"


@message(example={"images": 2, "matches": 17})
def image_not_placed(images: int, matches: int) -> str:
    return (
        f"it is in no model: it matches {images} {'image' if images == 1 else 'images'} of a model (at most "
        f"{matches} features), and COLMAP found no pose from them"
    )
