"""What a run refuses: options, outputs, inputs and places that do not go together."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_existing, say_metric, say_missing

_HOW_TIMES = (
    "give --frame-times (a CSV with name,t_s), --name-times (times in the file names), --exif-times, or --video (the "
    "one that the images were taken from)"
)


@message(example={"found": ("the target is bent",)})
def found_together(found: Sequence[Said]) -> str:
    return "; ".join(map(str, found))


@message(example={"models": (0, 1), "reasons": (("the camera hardly accelerates",), ("the camera hardly turns",))})
def scales_refused(models: Sequence[int], reasons: Sequence[Sequence[Said]]) -> str:
    return "; ".join(f"model {i}: {'; '.join(map(str, why))}" for i, why in zip(models, reasons, strict=True))


_ROOM = "free some space and start again; the run continues"
_RAISE = "raise the limit (ulimit -f) and start again; the run continues"


def _remove_or_choose(out: str, **_: object) -> str:
    return f"remove {out}, or choose another folder"


# captures

state("capture-has-no-frames", "has no frames", advice="add [images] or [video]", joint=": ")


@message(advice="leave it out, or take [rig] out", example={"option": "--database"})
def not_for_rigs(option: str) -> str:
    return f"{option}: not supported for cameras of a rig"


state(
    "database-of-which-images",
    "--database: the rolling shutter is corrected here. Give --database-images filmed if its keypoints were found in "
    "the images as filmed, rectified if in those of `deblur --rectify`; or disable the "
    "correction with --rolling-shutter off",
)

state(
    "gravity-priors-need-global",
    "--mapping.gravity-priors needs --mapping.mapper global: the incremental mapper ignores them",
)

state(
    "gravity-priors-need-calibration",
    "--mapping.gravity-priors needs the rotation between camera and IMU and their time offset beforehand",
    advice="give [calibration] in capture.toml or --calibration FILE, and shared_clock or a time offset",
    joint=": ",
)

state("frames-of-rig-not-deblurred", "frames of a rig's cameras are not deblurred", advice="take [rig] out", joint=": ")

state(
    "no-multi-aperture-camera", "describes no multi-aperture camera", advice="add [images] and [apertures]", joint=": "
)

state("no-pairs-of-exposures", "describes no pairs of exposures", advice="add [images] and [exposures]", joint=": ")


@message(example={"path": "capture.toml"})
def readout_needed(path: str) -> str:
    return (
        f"{path}: correcting the rolling shutter needs readout_s under [timing], the time from the first row "
        f"to the last"
    )


state("frames-on-another-clock", "puts the frames on another clock than the video's, to which its positions refer")

state("nothing-with-positions", "has neither a video nor images that could hold positions")

state("capture-has-no-pictures", "has no images", advice="add [images] or [video]", joint=": ")

state(
    "scale-from-plain-pictures",
    "scale without an IMU is for plain images",
    advice="fuse them first",
    joint=": ",
)

state(
    "scale-from-one-camera",
    "scale without an IMU is for a single camera",
    advice="take [rig] out",
    joint=": ",
)

# what a device's store takes


@message(example={"folder": "devices", "detail": "Permission denied"})
def folder_not_created(folder: str, detail: str) -> str:
    return f"{folder} cannot be created: {detail}"


@message(advice="remove it first", joint=": ", example={"path": "phone.json"})
def calibrated_by_rests(path: str) -> str:
    return f"{path} is a calibration from rests, which is better than one from targets"


@message(advice="give one result of each recording", example={"capture": "walk/capture.toml"})
def result_of_same_capture(capture: str) -> str:
    return f"is of {capture}, like another of these results"


state(
    "result-without-target",
    "has no scale with a measured target",
    advice="name the target under [target] of the capture",
)

state(
    "result-with-calibration",
    "its scale already used a calibration of the IMU",
    advice="run it without one (--no-remembered)",
)


@message(advice="measure it, and add +- to the target", example={"target": "aruco:4X4_50:0.1"})
def target_size_unstated(target: str) -> str:
    return f"the uncertainty of the size of {target} is not stated"


state("scale-of-another-method", "its scale is not that of the joint method")

state("device-without-name", "a device needs a name")


@message(advice="give a name that ends in .json; the page beside it ends in .html", example={"out": "phone.html"})
def calibration_is_json(out: str) -> str:
    return f"{out}: the calibration is a JSON file"


@message(advice="choose another name or remove it", example={"page": "phone.html"})
def calibration_page_exists(page: str) -> str:
    return f"{page} exists, and the calibration's page is written there"


# inputs

state("no-table-of-samples", "is not a table of samples, which --capture describes")


@message(advice=lambda model: f"give one of its models, {model}", joint=": ", example={"model": "project/sparse/0"})
def is_a_project(model: str) -> str:
    return "is a whole project"


@message(advice=lambda model, **_: f"give one of them, for example {model}", example={"count": 2, "model": "sparse/0"})
def holds_several_models(count: int, model: str) -> str:
    return f"holds {count} models"


state(
    "no-model-for-imu",
    "holds no COLMAP model (sparse/ or a model folder), which --imu and similar options describe: leave "
    "them out for a capture, which has its own description",
)

state("no-folder-of-pictures", say_missing("folder of images"), advice="give the project's images with --images DIR")

state(
    "model-without-times",
    "a COLMAP model has no frame times",
    advice="give --frame-times (a CSV with name,t_s) or --name-times (times in the file names)",
    joint=": ",
)


@message(advice="leave it out", example={"options": ("--database",)})
def not_for_an_existing_model(options: Sequence[str]) -> str:
    return f"{', '.join(options)}: an existing model is not mapped again, nor its images changed"


state("imu-missing", "the IMU recording: give --imu PATH")


state(
    "times-missing",
    "the times of its images: give --frame-times (a CSV with name,t_s) or --name-times (times in the file names)",
)


@message(example={"missing": ({"code": "imu-missing", "values": {}}, {"code": "times-missing", "values": {}})})
def inputs_missing(missing: Sequence[Said]) -> str:
    return f"needs {'; and '.join(map(str, missing))}"


_NEEDS_IMU = "is a COLMAP project and needs the IMU recording: give --imu PATH"


state("project-needs-imu", _NEEDS_IMU)


state("project-needs-imu-and-times", f"{_NEEDS_IMU}; and when its images were taken: {_HOW_TIMES}")


@message(advice=_HOW_TIMES, joint=": ", example={"project": "project"})
def project_untimed(project: str) -> str:
    return f"{project}: the times of its images are not known"


# outputs


@message(advice="create it first", example={"folder": "out"})
def no_parent_folder(folder: str) -> str:
    return f"{folder} is not a folder"


@message(advice="name a file in it", example={"path": "out"})
def output_is_a_folder(path: str) -> str:
    return f"{path} is a folder"


@message(advice="choose another name for the result", example={"path": "model.json"})
def output_is_an_input(path: str) -> str:
    return f"{path} is an input"


@message(advice="choose another name or remove it", example={"path": "scale.json"})
def output_is_foreign(path: str) -> str:
    return f"{path} exists and is not an earlier result"


@message(advice="choose another name or remove it", example={"path": "capture.toml"})
def output_exists(path: str) -> str:
    return say_existing(path)


@message(advice="choose another name for the contact sheet", example={"path": "sheet.png"})
def contact_sheet_exists(path: str) -> str:
    return say_existing(path)


@message(advice="name it so", example={"path": "sheet.jpg"})
def contact_sheet_is_png(path: str) -> str:
    return f"{path}: the contact sheet is a PNG"


@message(
    advice="give COLMAP's own project, or leave the folder as it is with --keep", example={"folder": "project/sparse/0"}
)
def already_metric(folder: str) -> str:
    return say_metric(folder)


@message(advice="leave it out", example={"model": "sparse/0"})
def rigs_not_refined(model: str) -> str:
    return f"--refine inertial: the images of {model} are of several cameras, and models with rigs cannot be refined"


@message(advice="rename it, or go in two steps, scale and apply", joint=": ", example={"path": "project/scale.json"})
def name_needed_by_output(path: str) -> str:
    return f"{path} has a name that the output folder uses itself"


@message(
    advice="leave out --dense, or rename it to have another one made", joint=": ", example={"folder": "project/dense"}
)
def dense_comes_along(folder: str) -> str:
    return f"{folder} is already included, in metres"


@message(advice="rename or remove it", example={"path": "out/sparse"})
def place_taken(path: str) -> str:
    return f"{path} has the name of the project's"


@message(advice="choose another output folder", example={"path": "out"})
def output_not_empty(path: str) -> str:
    return f"{path} is not empty"


@message(advice="choose another folder or remove it", example={"path": "out"})
def output_of_another_run(path: str) -> str:
    return f"{path} holds a model of other images or options"


@message(advice=_remove_or_choose, example={"path": "out/colmap/0/images.bin", "out": "out"})
def output_changed(path: str, out: str) -> str:
    return f"{path} is missing or was changed since it was made"


@message(advice="name a new folder for the images", example={"path": "pictures"})
def pictures_exist(path: str) -> str:
    return say_existing(path)


@message(advice="name a new folder for the metric model", example={"path": "metric"})
def metric_model_exists(path: str) -> str:
    return say_existing(path)


@message(advice=_remove_or_choose, example={"found": {"code": "not-a-result", "values": {}}, "out": "out"})
def record_unreadable(found: Said, out: str) -> str:
    return found.with_advice


# targets, distances and markers

state("apply-needs-unscaled", "--apply needs a model without a unit", advice="add --unscaled", joint=": ")

state(
    "markers-needed",
    "--bars and --check-points name markers",
    advice="give a target of markers, as aruco:DICT:SIDE_M",
    joint=": ",
)

state(
    "other-target-of-markers",
    "--other-target is for two boards",
    advice="distances between single markers go into --bars",
)

state("other-target-the-same", "--other-target must differ from --target")

state(
    "corners-too-few-to-keep-apart",
    "too few corners to keep control and check distances apart; --apply needs more views",
)


@message(advice="write metres between the two middles, as in 4.03+-0.002", joint=": ", example={"text": "4"})
def other_target_length(text: str) -> str:
    return f'--other-target ... "{text}"'


@message(example={"first": "3", "second": "3"})
def one_place(first: str, second: str) -> str:
    return f"{first} and {second} are the same place"


@message(advice="write metres and how well they are known, as in 4.20+-0.01", joint=": ", example={"text": "4.2"})
def distance_unreadable(text: str) -> str:
    return f'--distance "{text}"'


@message(example={"text": "1,2,x"})
def point_unreadable(text: str) -> str:
    return f'--between "{text}": a point is x,y,z in the units of the model'


@message(advice="write the number of a marker, or a point as x,y,z", joint=": ", example={"text": "three"})
def marker_unreadable(text: str) -> str:
    return f'--between "{text}"'


@message(example={"marker": "3", "measured": (1, 2)})
def marker_not_measured(marker: str, measured: Sequence[int]) -> str:
    return f"marker {marker} was not measured in the model; measured: {', '.join(map(str, measured)) or 'none'}"


state(
    "points-need-a-model",
    "--between with points needs the model that they belong to",
    advice="map first (with a target or two markers), or give a COLMAP project",
    joint=": ",
)


state("target-not-given", "--scale-from target needs the target: --target checkerboard:COLSxROWS:SQUARE_M or another")


state(
    "distance-not-given",
    "--scale-from distance needs --between A B (two marker numbers, or two points as x,y,z of the model) and "
    "--distance METRES+-SIGMA",
)


state("markers-not-given", "--between with markers needs what they are: --target aruco:DICT:SIDE_M")


@message(advice="leave it out", example={"option": "--database"})
def for_metres_of_the_imu(option: str) -> str:
    return f"{option} goes with a capture whose metres come from the IMU"


# notes on errors


@message(example={"page": "out/report.html"})
def found_on_page(page: str) -> str:
    return f"findings and remedies: {page}"


# the folder of a run


@message(advice="wait for it or choose another folder", example={"folder": "out"})
def run_at_work(folder: str) -> str:
    return f"another run is at work in {folder}"


@message(advice="wait for it or choose another folder", example={"folder": "out"})
def batch_at_work(folder: str) -> str:
    return f"another batch is at work in {folder}"


@message(advice="choose another output folder", example={"path": "out"})
def output_is_a_file(path: str) -> str:
    return f"{path} is a file"


@message(
    advice="choose another folder, or remove this one (view and write_report still read it)",
    joint=": ",
    example={"out": "out"},
)
def run_of_another_version(out: str) -> str:
    return f"{out} holds a run of another version, with another layout of folders"


@message(advice="choose another folder or remove it", example={"out": "out", "what": "capture", "named": "/data/walk"})
def run_of_another_kind(out: str, what: str, named: object) -> str:
    return f"{out} holds a run of another {what} ({named})"


@message(example={"option": "world", "now": "y-down", "before": "z-up"})
def option_changed(option: str, now: object, before: object) -> str:
    now, before = ("not given" if value is None else value for value in (now, before))
    return f"{option} = {now} (was {before})"


@message(
    advice="choose another folder, or give --overwrite to redo what depends on it",
    example={
        "out": "out",
        "step": "metric",
        "changes": ({"code": "option-changed", "values": {"option": "world", "now": "y-down", "before": "z-up"}},),
    },
)
def result_is_finished(out: str, step: str, changes: Sequence[Said]) -> str:
    why = "; ".join(map(str, changes)) or "the recording, a stage, the program, or an option that is not in config.toml"
    return f"{out} holds a finished result, and its step {step.replace('_', ' ')} would change: {why}"


state("device-in-output", "is a device, a pipe or a socket in an output folder", advice="remove it", joint=": ")


@message(advice=_RAISE, example={"folder": "out"})
def file_would_be_too_large(folder: str) -> str:
    return f"{folder}: a file in it would exceed the limit of file sizes"


@message(advice=_ROOM, example={"folder": "out", "detail": "No space left on device"})
def disk_full(folder: str, detail: str) -> str:
    return f"the disk of {folder} is full ({detail})"


@message(advice="choose a folder outside of it", example={"out": "images/out", "folder": "images"})
def output_among_pictures(out: str, folder: str) -> str:
    return f"{out} lies in {folder}, the folder of the capture's images"


@message(advice=_ROOM, example={"folder": "out", "free_bytes": 1000000, "needed_bytes": 50000000})
def disk_nearly_full(folder: str, free_bytes: int, needed_bytes: int) -> str:
    return (
        f"the disk of {folder} is nearly full: {free_bytes / 1e6:.0f} MB are left, and COLMAP's next step may "
        f"need {needed_bytes / 1e6:.0f} MB"
    )


@message(advice=_RAISE, example={"path": "database.db", "largest_bytes": 1000000, "needed_bytes": 50000000})
def file_size_limited(path: str, largest_bytes: int, needed_bytes: int) -> str:
    return (
        f"{path}: COLMAP cannot write it here: a file may have {largest_bytes / 1e6:.2g} MB, and this one "
        f"may need {max(1.0, needed_bytes / 1e6):.0f} MB"
    )


@message(
    advice=lambda out, **_: f"it says what {out} is for: choose another folder, or remove this one",
    example={"found": {"code": "not-a-result", "values": {}}, "out": "out"},
)
def owner_unreadable(found: Said, out: str) -> str:
    return found.with_advice


@message(
    advice="run it again",
    joint=": ",
    example={"found": {"code": "not-a-result", "values": {}}, "lost": "scale.json"},
)
def lost_since_its_run(found: Said, lost: str) -> str:
    return f"{found.with_advice}; {lost} was damaged or removed since its run"


# frames, pairs and stages of a user


@message(example={"detail": "no common view"})
def apertures_apart(detail: str) -> str:
    return f"the apertures do not fit together: {detail}"


@message(example={"width": 640, "height": 480, "aperture": "red", "aperture_width": 1920, "aperture_height": 1080})
def picture_unlike_its_aperture(
    width: int, height: int, aperture: str, aperture_width: int, aperture_height: int
) -> str:
    return f"is {width}x{height}, but {aperture} is calibrated for {aperture_width}x{aperture_height}"


@message(advice="write all with the same depth", example={"dtype": "uint8", "reference_dtype": "uint16"})
def depth_unlike_the_reference(dtype: str, reference_dtype: str) -> str:
    return f"holds {dtype} pixels, the reference {reference_dtype}"


@message(advice="leave it out, or leave out the long ones by --exposures.no-fuse", example={"deblur": "wiener"})
def fused_not_deblurred(deblur: str) -> str:
    return f"--deblur {deblur}: frames of short and long exposures are fused, not deblurred"


@message(example={"width": 640, "height": 480, "frame": "0007.jpg", "short_width": 1920, "short_height": 1080})
def long_exposure_of_other_size(width: int, height: int, frame: str, short_width: int, short_height: int) -> str:
    return f"is {width}x{height}, but its short exposure {frame} is {short_width}x{short_height}"


@message(advice="write both in the same way", example={"kind": "grey", "frame": "0007.jpg", "short_kind": "in colour"})
def long_exposure_of_other_kind(kind: str, frame: str, short_kind: str) -> str:
    return f"is {kind}, but its short exposure {frame} is {short_kind}"


@message(
    advice="write both with the same depth", example={"dtype": "uint8", "frame": "0007.jpg", "short_dtype": "uint16"}
)
def long_exposure_of_other_depth(dtype: str, frame: str, short_dtype: str) -> str:
    return f"holds {dtype} pixels, its short exposure {frame} {short_dtype}"


@message(
    advice="all images of a capture must have the camera's size",
    example={"width": 640, "height": 480, "camera_width": 1920, "camera_height": 1080},
)
def picture_unlike_the_camera(width: int, height: int, camera_width: int, camera_height: int) -> str:
    return f"is {width}x{height}, but the camera is {camera_width}x{camera_height}"


@message(example={"count": 2, "of": 300})
def frames_left_too_few(count: int, of: int) -> str:
    return f"{count} frames are left of {of}; a model needs at least three"


@message(example={"dtype": "uint16", "suffix": ".jpg"})
def picture_not_writable(dtype: str, suffix: str) -> str:
    return f"OpenCV cannot write {dtype} images as {suffix}"


@message(
    advice=("leave one out (--join off leaves out the default one), or name the default one in `replaces` of yours"),
    joint=": ",
    example={"stages": ("Join", "MyJoin")},
)
def two_stages_join(stages: Sequence[str]) -> str:
    return f"two model stages join models ({' and '.join(stages)}), and only one can"


@message(example={"stage": "mine:sharpen", "module": "mine", "name": "sharpen"})
def stage_not_in_module(stage: str, module: str, name: str) -> str:
    return f"stage {stage}: {module} has no {name}"


@message(advice="name an instance of it, or a function", example={"stage": "mine:Sharpen"})
def stage_is_a_class(stage: str) -> str:
    return f"stage {stage}: is a class"


@message(advice="name a function or another callable", example={"stage": "mine:three", "type": "int"})
def stage_not_callable(stage: str, type: str) -> str:
    return f"stage {stage}: is of type {type}"


@message(example={"stage": "mine:sharpen", "why": {"code": "module-of-stage-missing", "values": {"module": "mine"}}})
def stage_not_imported(stage: str, why: Said) -> str:
    return f"stage {stage}: {why.with_advice}"


@message(advice="install it on the machine that processes the capture, or set PYTHONPATH", example={"module": "mine"})
def module_of_stage_missing(module: str) -> str:
    return f"there is no module {module}"


@message(example={"module": "mine", "detail": "SyntaxError: invalid syntax"})
def module_of_stage_failed(module: str, detail: str) -> str:
    return f"{module} cannot be imported: {detail}"
