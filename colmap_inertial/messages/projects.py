"""Words on existing projects, targets of known size, exports and what is shown of a model."""

from __future__ import annotations

from math import degrees

from colmap_inertial.messages import Said, message, state

# times of a project's images


@message(example={"digits": 1})
def exif_times_coarse(digits: int) -> str:
    return f"EXIF gives the frames' times only to 1/{10**digits} s"


state("not-of-video", "is not a frame of the video")
state("same-frame-as-another", "is the same frame as another image")
state("looks-like-several-frames", "looks like several frames of the video")


@message(example={"count": 3, "images": 120, "why": "is no frame of the video", "first": "0001.jpg"})
def images_untimed_by_video(count: int, images: int, why: Said, first: str) -> str:
    return f"{count} of {images} images have no time: each {why} (first: {first})"


@message(
    example={"video": "clip.mp4", "found": 2, "images": 120, "name": "0001.jpg", "why": "is no frame of the video"}
)
def video_of_other_images(video: str, found: int, images: int, name: str, why: Said | None) -> str:
    return (
        f"{video}: {found} of {images} images were identified with certainty among its frames ({name} "
        f"{why or ''}): give the video that the images were taken from, or --frame-times"
    )


# a project that is made metric


@message(example={"folder": "sparse/1"})
def model_left_out(folder: str) -> str:
    return f"{folder} and what was made from it are left out: its scale is refused"


@message(example={"folder": "sparse/0", "names": ("0001.jpg", "0002.jpg")})
def contradicting_images_left_out(folder: str, names: tuple[str, ...]) -> str:
    return (
        f"{folder}: {len(names)} images contradict the gyroscope and were left out: "
        f"{', '.join(names[:5])}{' ...' if len(names) > 5 else ''}"
    )


@message(example={"file": "database.db", "count": 5, "kind": "pose priors"})
def not_in_model_frame(file: str, count: int, kind: str) -> str:
    return f"{file}: {count} {kind} are not in a model's frame and are unchanged"


def _priors_stay(file: str, count: int, kind: str) -> str:
    return f"{file}: {count} pose {'prior' if count == 1 else 'priors'} {kind} are unchanged"


_PRIORS = {"file": "database.db", "count": 120, "kind": "in degrees (WGS84)"}


@message(example={**_PRIORS, "ratio": 1.01, "sigma": 0.02})
def priors_agree(file: str, count: int, kind: str, ratio: float, sigma: float) -> str:
    apart = f"they are {ratio:.3f} +- {sigma:.2g} times as far apart as the model is now"
    return f"{_priors_stay(file, count, kind)}, and agree with its metres: {apart}"


@message(
    advice="the scale or the positions are wrong, or these are not metres; do not give both to one adjustment",
    example={**_PRIORS, "ratio": 3.2, "sigma": 0.1},
)
def priors_contradict(file: str, count: int, kind: str, ratio: float, sigma: float) -> str:
    apart = f"they are {ratio:.3f} +- {sigma:.2g} times as far apart as the model is now"
    return f"{_priors_stay(file, count, kind)}, and contradict its metres: {apart}"


@message(example=_PRIORS)
def priors_say_little(file: str, count: int, kind: str) -> str:
    return f"{_priors_stay(file, count, kind)}; they are too few, or scatter too much, to compare their metres"


# a scale without an IMU

state("up-unknown-without-imu", "which way is up is not known: no IMU was used")
state("treatment-without-imu", "no IMU was used: frames are as they were filmed, with any blur and rolling shutter")
state("target-without-images", "the target was not measured: the project has no images/; give --images DIR")


@message(example={"proof": "lengths up to 0.2 m agree within the errors given here"})
def target_proves(proof: Said) -> str:
    return f"this proves that {proof}"


@message(example={"error": 0.004})
def check_corners_off(error: float) -> str:
    return f"the check corners, which the scale does not use, are {100 * error:+.2g} % off"


@message(example={"images": (5, 3)})
def more_models_left_out(images: tuple[int, ...]) -> str:
    return f"COLMAP made {len(images)} more models, of {', '.join(map(str, images))} images: left out"


# a target in a model

state("view-without-file", "no such file in the image folder")
state("view-unreadable", "the image cannot be read")
state("view-target-not-found", "target not found")
state("view-disagrees", "does not agree with the other views: a false detection, another target, or a wrong pose")
state("view-markers-unconfirmed", "shows only markers that no other view confirms")
state("view-corners-disagree", "fewer than four of its corners agree with the other views")
state("view-corners-far-off", "its residuals are more than four times those of the other views")
state("views-disagree", "the views of the target do not agree with each other in the model")


@message(example={"width": 1920, "height": 1080, "camera_width": 3840, "camera_height": 2160})
def view_of_other_size(width: int, height: int, camera_width: int, camera_height: int) -> str:
    return (
        f"the image is {width}x{height} and its camera in the model {camera_width}x{camera_height}: "
        "give the images that the model was made from"
    )


@message(example={"part": "marker 7", "difference": 0.08})
def marker_of_other_size(part: str, difference: float) -> str:
    return f"{part} is left out: {100 * difference:+.1f} % against the others; does it have another size?"


state("target-without-check-set", "too few corners to keep a control and a check set apart")


@message(example={"views": 3})
def target_in_few_views(views: int) -> str:
    return f"only {views} views: the interval is wide, as pose errors are poorly known from so few"


@message(example={"images": 2})
def several_targets(images: int) -> str:
    return f"{images} images show more than one such target; the one with the most consistent views was measured"


@message(example={"shift_px": 0.4})
def target_moved_by_poses(shift_px: float) -> str:
    return f"pose errors of the model shift the target by {shift_px:.2f} px (included in the interval)"


state(
    "target-sigma-unknown",
    "the interval does not include errors of the target itself: measure the print and state its standard "
    "deviation (+- in the description)",
)


@message(example={"sigma_share": 0.002})
def target_sigma_included(sigma_share: float) -> str:
    return f"the interval includes the target's own standard deviation of {100 * sigma_share:.2g} %"


@message(example={"images": 40})
def images_not_searched(images: int) -> str:
    return f"{images} images were not searched: enough views were found"


@message(example={"used": 2, "searched": 30})
def target_size_not_proved(used: int, searched: int) -> str:
    return (
        f"only {used} of {searched} images agree on the target, too few to prove its size: "
        "check its columns and rows, or film it from more sides"
    )


@message(example={"largest_m": 0.004, "tolerance_share": 0.005, "longest_m": 0.2})
def target_lengths_disagree(largest_m: float, tolerance_share: float, longest_m: float) -> str:
    return (
        f"its lengths contradict each other: one is off by {1000 * largest_m:+.3g} mm, more than "
        f"{100 * tolerance_share:g} % of the longest ({1000 * longest_m:.4g} mm): check its columns and rows, "
        "and that it is flat"
    )


_SIDES = {"aprilgrid": "tag side", "aruco": "marker side"}


@message(example={"kind": "checkerboard", "stated_m": 0.03, "fits_m": 0.04})
def target_or_scale_wrong(kind: str, stated_m: float, fits_m: float) -> str:
    return (
        f"all lengths are off by {100 * (fits_m / stated_m - 1):+.1f} %: the {_SIDES.get(kind, 'square side')} of "
        f"{stated_m:.4g} m or the model's scale is wrong; {fits_m:.4g} m would fit"
    )


@message(
    example={"longest_m": 0.3, "diagonal_m": 12.0, "longest_share": 0.025, "directions": 2, "shows_elsewhere": "little"}
)
def lengths_agree(
    longest_m: float,
    diagonal_m: float | None,
    longest_share: float | None,
    directions: int,
    shows_elsewhere: str | None,
) -> str:
    checked = f"lengths up to {longest_m:.3g} m agree with each other within the errors given here"
    if longest_share is None or diagonal_m is None:
        return checked
    checked += f", in {'one direction' if directions == 1 else f'{directions} directions'}"
    if shows_elsewhere is None:
        return f"{checked} and over {100 * longest_share:.0f} % of the model's diagonal of {diagonal_m:.3g} m"
    would = "hardly" if shows_elsewhere == "little" else "not"
    return (
        f"{checked}; they span {100 * longest_share:.2g} % of the model's diagonal of {diagonal_m:.3g} m and would "
        f"{would} show bend or drift elsewhere"
    )


@message(example={"spec": "checkerboard:9x6:0.025", "found": 30, "agreeing": 6})
def target_seldom_agrees(spec: str, found: int, agreeing: int) -> str:
    return (
        f"{spec} was detected in {found} images, but only {agreeing} of them agree on its position in the model: "
        "check the number of columns and rows (inner corners of a checkerboard), and "
        "that the target did not move"
    )


@message(example={"views": 2})
def target_views_too_close(views: int) -> str:
    return (
        f"{views} views of the target are too close together or too inconsistent; "
        "more views from different sides are needed"
    )


@message(example={"largest_angle_rad": 0.007})
def target_along_one_line(largest_angle_rad: float) -> str:
    return (
        f"all views see the target from the same direction (within {degrees(largest_angle_rad):.2f} deg): a length "
        "needs views from different places"
    )


@message(example={"name": "0001.jpg"})
def target_in_one_image(name: str) -> str:
    return (
        f"the target was found in one image only ({name}): a length needs it in two images or more, "
        "taken from different places"
    )


@message(example={"spec": "checkerboard:9x6:0.025", "images": 30, "hint": "is the description right?"})
def target_not_found(spec: str, images: int, hint: Said) -> str:
    return f"{spec} was not found in any of the {images} images that were searched; {hint}"


state(
    "target-description-in-doubt", "is the description right, and is the target large and sharp enough in the images?"
)
state(
    "aprilgrid-in-doubt",
    "the tags of Kalibr are expected (36h11 from number 0 on, black border of two bits): check that these are yours, "
    "and that the target is large and sharp enough in the images",
)
state(
    "inner-corners",
    "COLSxROWS counts inner corners, one less than squares; the whole board must be in view, with a white rim",
)


@message(example={"columns": 8, "rows": 6})
def other_board_visible(columns: int, rows: int) -> str:
    return f"a board with {columns}x{rows} inner corners was detected: is the size in the description right?"


#: What else than moving places a target that is found in many images nowhere, the likelier first, by its kind.
_PLACED_NOWHERE = {
    "aprilgrid": "columns and rows may be swapped (COLSxROWS of tags), or the tags not numbered row by row from the "
    "lower left one, as kalibr has them; else wrong poses",
}


@message(example={"spec": "checkerboard:9x6:0.025", "kind": "checkerboard", "images": 30, "residual_px": 20.0})
def target_nowhere_alike(spec: str, kind: str, images: int, residual_px: float) -> str:
    return (
        f"{spec} was detected in {images} images, but no two of them agree on its position in the model "
        f"(to {residual_px:g} px): {_PLACED_NOWHERE.get(kind, 'false detections, wrong poses')}, a target that moved "
        "between the images, or images that do not belong to this model"
    )


_MIRRORED = {"horizontal": "left to right", "vertical": "top to bottom"}


@message(example={"along": "horizontal"})
def images_mirrored(along: str) -> str:
    return f"the images are mirrored {_MIRRORED[along]} relative to the model: give those it was made from"


@message(example={"spec": "checkerboard:6x5:0.025", "columns": 9, "rows": 6})
def part_of_larger_board(spec: str, columns: int, rows: int) -> str:
    return f"{spec} is a part of a board with {columns}x{rows} inner corners: give the size of the whole board"


@message(example={"spec": "checkerboard:9x6:0.025", "used": 4, "searched": 30, "columns": 8, "rows": 5})
def other_board_likelier(spec: str, used: int, searched: int, columns: int, rows: int) -> str:
    return (
        f"{spec} agrees in {used} of {searched} images, and a board with "
        f"{columns}x{rows} inner corners is in more of them: COLSxROWS counts inner corners, one less than "
        "squares"
    )


# exports

state("up-is-not-z", "up is not z in this model (see up_in_world), while most trainers' viewers assume z")
state("never-scaled", "this model was never scaled")
state("blur-not-modelled", "exposure times are unknown and taken as 0: blur is not modelled")
state(
    "one-exposure-for-all",
    "exposure times differ between images; the program needs a single one: their median is given",
)
state("one-pose-each", "no velocities are known: each image has one pose, as with a global shutter")


@message(example={"left_out": 3, "images": 120})
def images_without_velocity(left_out: int, images: int) -> str:
    return f"{left_out} of {images} images have no velocity and are left out of transforms.json"


@message(example={"count": 120})
def pictures_with_shutter(count: int) -> str:
    return (
        f"{count} images have a rolling shutter, which the model lacks: they agree with it only in the middle "
        "row, unless the program models the shutter"
    )


@message(example={"count": 120})
def pictures_rectified(count: int) -> str:
    return f"{count} images are rectified: those with their rolling shutter (colmap/images) are missing"


@message(example={"count": 40})
def pictures_deblurred(count: int) -> str:
    return f"{count} images are deblurred; with --capture, they are taken from it as filmed"


# the viewer


@message(example={"most_faces": 2000000})
def mesh_not_shown(most_faces: int) -> str:
    return f"the mesh has no faces, or more than {most_faces}"
