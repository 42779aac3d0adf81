"""Words of what a capture.toml or another TOML file says wrongly."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import message, state


@message(example={"count": 3000000, "most": 2097152})
def toml_too_long(count: int, most: int) -> str:
    return f"has {count} characters; such a file has at most {most}"


@message(example={"most": 32})
def toml_key_too_deep(most: int) -> str:
    return f"has a key of more than {most} dotted parts"


@message(example={"detail": "Invalid value (at line 3, column 8)"})
def invalid_toml(detail: str) -> str:
    return f"not valid TOML: {detail}"


@message(example={"name": "imu.gyro"})
def not_a_table(name: str) -> str:
    return f"must be a table: write [{name}] on a line of its own"


@message(example={"found": "3"})
def not_a_text(found: str) -> str:
    return f"must be a string in quotes, found {found}"


@message(example={"allowed": ("down", "up"), "found": "'left'"})
def not_one_of(allowed: tuple[str, ...], found: str) -> str:
    return f"must be one of {', '.join(map(repr, allowed))}; found {found}"


state("nul-character", "holds a NUL character")


@message(example={"found": "1"})
def not_a_boolean(found: str) -> str:
    return f"must be true or false, found {found}"


@message(example={"low": 0.0, "high": 1.0, "found": "7"})
def not_in_range(low: float, high: float, found: str) -> str:
    return f"must be from {low:g} to {high:g}, found {found}"


@message(example={"found": "-1.0"})
def not_above_zero(found: str) -> str:
    return f"must be above 0, found {found}"


@message(example={"found": "-1"})
def not_a_positive_integer(found: str) -> str:
    return f"must be a whole number above 0, found {found}"


state("not-a-matrix", "must be a matrix: a list of rows, each a list of numbers")


@message(example={"key": "path"})
def key_missing(key: str) -> str:
    return f"{key} is missing"


@message(example={"found": "'3'"})
def not_a_number(found: str) -> str:
    return f"must be a number, found {found}"


@message(example={"found": "[]"})
def not_paths(found: str) -> str:
    return f"must be a path in quotes, or a list of them, found {found}"


@message(example={"count": 3, "found": "[1, 2]"})
def not_numbers(count: int | None, found: str) -> str:
    return f"must be a list of {'' if count is None else f'{count} '}numbers, found {found}"


@message(example={"near": ("path",), "known": ("path", "format")})
def unknown_key(near: Sequence[str], known: Sequence[str]) -> str:
    hint = f'; did you mean "{near[0]}"?' if near else ""
    return f"unknown key{hint} (known: {', '.join(known)})"


@message(example={"found": "inf"})
def not_finite(found: str) -> str:
    return f"must be finite, found {found}"


@message(example={"tables": ("images", "video")})
def tables_exclude_each_other(tables: Sequence[str]) -> str:
    listed = ", ".join(f"[{table}]" for table in tables[:-1])
    return f"a capture has {listed} or [{tables[-1]}], not {'both' if len(tables) == 2 else 'several of them'}"


state("rig-gives-camera", "gives the camera by its calibration", advice="leave out [camera]")
state("rig-gives-main-camera", "gives the main camera, too", advice="leave out [camera]")
state("file-gives-calibration", "gives the calibration", advice="leave out the other keys of this table")


@message(
    advice=lambda others: f"leave out {', '.join(others[:-1])} and {others[-1]}",
    example={"others": ("model", "width", "height", "params", "pixel_origin")},
)
def sheet_gives_intrinsics(others: Sequence[str]) -> str:
    return "gives the intrinsics"


state("main-camera-missing", "needs [images] or [video] of the main camera, which is missing")
state("reference-pictures-missing", "needs [images], the folder of the reference's images, which is missing")
state("short-exposures-missing", "needs [images], the folder of the short exposures, which is missing")


@message(example={"key": "path"})
def belongs_to_missing(key: str) -> str:
    return f"needs {key}, which is missing"


state("translation-said-twice", "and the last column of cam_from_imu give the same value", advice="leave one out")


@message(advice="leave one out", example={"other": "rate_hz"})
def said_twice(other: str) -> str:
    return f"and {other} give the same value"


state("same-pictures-as-reference", "has the same images as the reference", advice="give folder or rename")
state("same-pictures-as-images", "has the same images as [images]", advice="give folder or rename")


@message(example={"units": ("s", "ns", "date"), "columns": 2, "found": "'h'"})
def not_a_time_unit(units: Sequence[str], columns: int, found: str) -> str:
    several = "" if columns == 1 else f", a list with one of them for each of the {columns} columns"
    return f"must be one of {', '.join(map(repr, units))}{several}; found {found}"


state(
    "no-capture-file",
    "a capture is described by a .toml file or a folder, unless it is a video with an IMU inside",
    advice="write a capture.toml beside it",
)
state("capture-of-nothing", "describes neither frames ([images] or [video]) nor an IMU ([imu])")
state("images-of-other-camera", "has the images of another camera", advice="give its own folder or video")
state("recipe-without-capture", "holds a recipe, which `colmap-inertial simulate recipe.toml OUT` renders to a capture")
state(
    "no-capture-folder",
    (
        "is not a capture: it holds no capture.toml, and is neither an ASL/EuRoC dataset "
        "(cam0/data.csv, cam0/data/, imu0/data.csv) nor an InertialScale folder"
    ),
    advice="describe it in a capture.toml (images without an IMU: reconstruct --scale-from target or another)",
)


@message(example={"old": "VIS", "name": "a.jpg"})
def rename_fits_not(old: str, name: str) -> str:
    return f""""{old}" of rename does not occur in the reference's file name {name!r}"""


@message(example={"found": "'a'"})
def not_a_rename(found: str) -> str:
    return f"must be two strings, the old and the new part of the name; found {found}"


@message(example={"found": 1})
def apertures_too_few(found: int) -> str:
    return f"needs two or more apertures, each a table [apertures.NAME]; found {found}"


state(
    "reference-in-other-folder",
    "is that of [images] for the reference, the first aperture",
    advice="leave it and rename out",
)
state("no-picture-of-size", "holds no image to take the size from, which the calibration does not give")


@message(
    advice="if both kinds are in one folder, let pattern under [images] match the short ones only",
    example={"old": "S", "name": "a.jpg"},
)
def short_exposure_not_renamed(old: str, name: str) -> str:
    return f""""{old}" of rename under [exposures] does not occur in the short exposure's name {name!r}"""


@message(
    advice="correct folder or rename under [exposures], or take the short one out of [images]",
    example={"name": "S1.jpg"},
)
def long_exposure_missing(name: str) -> str:
    return f"no such image: the long exposure of {name} is missing"


@message(example={"times": "times.csv", "name": "L1.jpg", "short": "S1.jpg"})
def long_exposure_without_time(times: str, name: str, short: str) -> str:
    return f"{times}: no row for {name}, the long exposure of {short}"


@message(example={"times": "times.csv", "short": "S1.jpg", "late_s": 30.0})
def long_exposure_far(times: str, short: str, late_s: float) -> str:
    return (
        f"{times}: the long exposure of {short} starts {late_s:.3g} s after the short one; both must be timed "
        "by one clock, and belong together"
    )


state("delay-beside-times", "cannot be given together with times", advice="leave one of them out")
state("rig-without-cameras", "needs a table [rig.NAME] for each camera but the main one")
state("pose-of-some-cameras", "give cam_from_reference of each camera, or of none")
state("calibration-without-unit", "holds lengths without a unit", advice='give unit = "m" or "mm"')


@message(advice="each has its own", example={"name": "cam1"})
def calibrated_camera_twice(name: str) -> str:
    return f"{name!r} is also that of another camera"


@message(advice="give camera, or reference under [rig]", example={"name": "cam0"})
def calibrated_camera_is_main(name: str) -> str:
    return f"{name!r} is the main camera in the calibration"


state("pose-not-4x4", "must be a 4x4 matrix, with the translation in metres")


@message(example={"name": "cam 1"})
def camera_name_unsuited(name: str) -> str:
    return f"the camera's name {name!r} becomes a folder: use only letters, digits, - and _"


@message(advice="describe each camera in a table of its own", example={"name": "cam1"})
def camera_without_size(name: str | None) -> str:
    return f"gives no image size of {name or 'the first camera'}"


state("imu-path-is-capture", "must be a recording, not another capture.toml")
state("imu-table-needs-path", "needs path, or [imu.gyro] (and [imu.accel], for scale and gravity) that describe tables")
state("not-a-unit-quaternion", "must be a quaternion x, y, z, w of length 1")


@message(example={"found": "['x', 'y']"})
def not_three_columns(found: str) -> str:
    return f"must be three names, or numbers counted from 1, of x, y and z; found {found}"


state("columns-repeated", "must be three different columns, none of them the time")


@message(example={"found": "0"})
def not_a_column(found: str) -> str:
    return f"must be a column's name, or its number counted from 1; found {found}"


state("counts-need-one-column", "is for one time column without time_unit")


@message(example={"found": "'GYRO'"})
def not_a_row_choice(found: str) -> str:
    return f'must be a column and its value in the rows to take, as [1, "GYRO"]; found {found}'


@message(
    advice="correct a sign or the order, or add mirrored = true if the file's own axes are left-handed",
    example={"axes": "-x,y,z"},
)
def axes_mirror(axes: str) -> str:
    return f'"{axes}" turns a right-handed frame into a left-handed one'


@message(example={"axes": "x,y,z"})
def axes_do_not_mirror(axes: str) -> str:
    return f'is true, but axes = "{axes}" keeps the handedness'


@message(example={"model": "PINHOLE", "count": 4, "found": 3})
def camera_params_count(model: str, count: int, found: int) -> str:
    return f"{model} has {count} parameters, found {found}"


state(
    "pixel-origin-missing",
    "pixel_origin is missing",
    advice=""""corner" if params are COLMAP's, "center" if they are OpenCV's or Kalibr's""",
    joint=": ",
)
state("focal-lengths-not-positive", "focal lengths must be above 0")


@message(example={"rows": 2, "columns": 3})
def not_a_pose(rows: int, columns: int) -> str:
    return f"must be a 3x3 or 4x4 matrix, found {rows}x{columns}"


state("matrix-not-a-rotation", "is not a rotation: rows must be perpendicular, of length 1, and right-handed")
state("last-row-wrong", "must have 0, 0, 0, 1 as its last row")


@message(example={"units": ("s", "ms")})
def name_times_without_unit(units: tuple[str, ...]) -> str:
    return f'"name" needs time_unit, one of {", ".join(units)}'


@message(example={"found": "'../*.jpg'"})
def pattern_outside(found: str) -> str:
    return f"must stay inside folder, found {found}"


@message(example={"pattern": "../*.jpg"})
def pattern_leads_out(pattern: str) -> str:
    return f"the pattern {pattern!r} leads outside of it"


state("capture-without-frames", "describes no frames", advice="add [images] or [video]")
state(
    "capture-without-imu",
    "describes no inertial recording",
    advice="add [imu] with path = ..., or take the metres from something else (reconstruct --scale-from)",
)
