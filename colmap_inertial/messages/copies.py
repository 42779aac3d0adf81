"""What models, their files, scales in files and the copy of a project refuse."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_existing, say_metric, say_missing

_KEEP = "leave the file out with --keep"


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


# models


@message(advice="remove one of them", example={"model": 0, "provenance": "inertial scale"})
def scaled_before(model: int, provenance: str) -> str:
    return f"model {model} was already scaled by an earlier stage ({provenance})"


state("no-model-here", "no COLMAP model here (cameras, images and points3D, .bin or .txt)")


@message(example={"detail": "images.bin: bad alloc"})
def model_not_read(detail: str) -> str:
    return f"COLMAP cannot read this model: {detail}"


state("no-registered-image", "the model has no registered image")


@message(advice="apply it to COLMAP's own model", example={"folder": "sparse/0", "provenance": "inertial scale"})
def metric_already(folder: str, provenance: str) -> str:
    return say_metric(folder, provenance)


@message(advice="choose another folder or remove it", example={"path": "metric"})
def target_exists(path: str) -> str:
    return say_existing(path)


@message(example={"why": {"code": "records-claimed", "values": {"count": 3}}})
def damaged_model_file(why: Said) -> str:
    return f"damaged: {why}"


@message(example={"count": 8})
def bytes_after_last_record(count: int) -> str:
    return f"damaged: {count} bytes follow the last record"


@message(example={"camera": 1, "width": 0, "height": 480})
def camera_size_impossible(camera: int, width: int, height: int) -> str:
    return f"camera {camera} has {width} x {height} pixels"


@message(example={"camera": 1, "model": "PINHOLE", "names": "fx, fy, cx, cy", "params": (1000000000.0, 1.0, 0.0, 0.0)})
def camera_impossible(camera: int, model: str, names: str, params: Sequence[float]) -> str:
    return f"camera {camera} ({model}) has impossible parameters: {names} = {_listed(params)}"


@message(example={"image": "a.jpg", "numbers": (0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0)})
def pose_impossible(image: str, numbers: Sequence[float]) -> str:
    return f"the pose of {image!r} is impossible: {_listed(numbers)}"


@message(example={"rig": 1, "sensor": 2})
def rig_pose_impossible(rig: int, sensor: int) -> str:
    return f"rig {rig}: the pose of sensor {sensor} is impossible"


@message(example={"point": 1, "xyz": (1e30, 0.0, 0.0)})
def point_impossible(point: int, xyz: Sequence[float]) -> str:
    return f"point {point} lies at {_listed(xyz)}"


@message(example={"detail": "truncated data"})
def not_text(detail: str) -> str:
    return f"no text: {detail}"


@message(example={"count": 3})
def records_claimed(count: int) -> str:
    return f"it claims {count} records"


@message(example={"width": 0, "height": 480})
def camera_without_pixels(width: int, height: int) -> str:
    return f"a camera of {width} x {height} pixels"


# databases

state("not-sqlite", "not an SQLite database")


@message(example={"size_bytes": 1000, "pages": 10, "page_bytes": 4096})
def database_truncated(size_bytes: int, pages: int, page_bytes: int) -> str:
    return f"truncated: {size_bytes} bytes instead of {pages} pages of {page_bytes}"


@message(example={"what": "pose prior", "count": 3})
def blob_of_other_length(what: str, count: int) -> str:
    return f"damaged: a {what} is not {count} numbers"


_UNREADABLE = "COLMAP cannot read its database; restore it, or start again in another folder"
state("database-unreadable", _UNREADABLE)


@message(example={"table": "matches"})
def record_of_other_size(table: str) -> str:
    return f"{_UNREADABLE} (a record of {table} has another size than it states)"


# depth maps, meshes and settings beside a model

state("not-a-depth-map", "not a depth or normal map of COLMAP: it does not begin with width&height&channels&")


@message(example={"found": 3, "expected": 1})
def map_of_other_channels(found: int, expected: int) -> str:
    return f"its header states {found} channels instead of {expected}"


@message(example={"width": 0, "height": 480})
def map_of_no_size(width: int, height: int) -> str:
    return f"its header states {width} x {height} pixels"


@message(example={"size_bytes": 1000, "expected_bytes": 2000, "width": 20, "height": 25, "channels": 1})
def map_of_other_length(size_bytes: int, expected_bytes: int, width: int, height: int, channels: int) -> str:
    state = "truncated" if size_bytes < expected_bytes else "damaged"
    return f"{state}: {size_bytes} bytes instead of {expected_bytes} for {width} x {height} x {channels}"


state("truncated-while-read", "truncated while it was read")


@message(advice=_KEEP, example={"key": "box"})
def bounding_box(key: str) -> str:
    return f"{key}: a bounding box cannot be transformed"


@message(example={"key": "depth_min"})
def setting_no_number(key: str) -> str:
    return f"{key} is not a number"


@message(example={"text": "b'v 1 2 x'"})
def not_three_numbers(text: str) -> str:
    return f"not three numbers: {text}"


state("vertex-incomplete", "a vertex or normal without three numbers")

state("line-without-end", "a line does not end")

state("changed-while-read", "was changed while it was read")

state("scale-not-above-zero", "has a scale that is not a number above 0", advice=_KEEP)


@message(advice="leave it out with --keep", example={"unit": "parsec"})
def unit_no_length(unit: str) -> str:
    return f"the unit {unit!r} is not a length"


state("not-a-vector", "a vector that is not three numbers", advice=_KEEP)


state("not-a-transform", "a transform that is not a matrix of 3 or 4 rows of 4 numbers", advice=_KEEP)

# the copy of a project


@message(example={"path": "metric"})
def written_by_another(path: str) -> str:
    return f"another process is writing {path}"


@message(advice="choose another folder", example={"path": "metric"})
def target_appeared(path: str) -> str:
    return f"{path} appeared in the meantime"


@message(
    advice="nothing was left behind",
    example={"path": "metric", "why": {"code": "copy-disk-full", "values": {}}, "name": "metric/a.ply"},
)
def copy_not_written(path: str, why: Said, name: str | None) -> str:
    return f"{path} cannot be written: {why}{'' if name is None else f' ({name})'}"


state("link-leads-back", "this link leads back to a folder above it")


@message(advice="--follow-links (follow_links=True) copies what it points to", example={"target": "/data/images"})
def link_out_not_followed(target: str) -> str:
    return f"is a link out of the project, to {target}"


state("neither-file-nor-folder", "neither a file nor a folder", advice="move it out of the project")


@message(
    advice="apply it to COLMAP's own project, or take it back with --undo",
    example={"folder": "project/sparse/0", "provenance": "inertial scale"},
)
def metric_already_in_project(folder: str, provenance: str) -> str:
    return say_metric(folder, provenance)


state("not-a-record-of-apply", "not the record of a project that colmap-inertial apply wrote")

state("models-not-as-recorded", "the models of the project are not those that it records")

state("no-such-folder", say_missing("folder"))

state(
    "owner-unknown",
    "it is not known in which sub-model's units this is",
    advice="move it into its dense workspace or leave it out with --keep",
)


@message(example={"folder": "out/sparse/0", "detail": "truncated"})
def model_not_whole(folder: str, detail: str) -> str:
    return f"{folder}: COLMAP wrote the model incompletely; is the disk full? ({detail})"


state(
    "workspace-of-several-models", "this dense workspace holds more than one model: it is not known to which it belongs"
)

state("depth-maps-of-several-models", "depth maps beside several sub-models: it is not known to which they belong")


@message(advice="leave others out with --keep", example={"folders": ("a", "b")})
def several_candidates(folders: Sequence[str]) -> str:
    return f"it is not known which of these is COLMAP's model: {', '.join(folders)}"


@message(example={"folders": ("sparse/0", "sparse/1")})
def belongs_to_several(folders: Sequence[str]) -> str:
    return f"it is not known which of {' and '.join(folders)} this belongs to"


@message(advice="leave it out with --keep", example={"other": "sparse/0"})
def model_elsewhere(other: str) -> str:
    return (
        f"its images are those of {other}, but its cameras are elsewhere: it was made from another model, "
        "with another scale"
    )


state("images-of-no-submodel", "its images are those of none of the sub-models", advice="leave it out with --keep")


state("copy-disk-full", "the disk is full")


state("copy-quota-used", "the quota is used up")


state("copy-file-too-large", "the file is too large")

# scales in files

state("no-similarity", "no similarity: the field scale is missing")


@message(example={"name": "cov", "shape": (7, 7)})
def field_not_of_shape(name: str, shape: Sequence[int]) -> str:
    return f"{name} must be {' x '.join(map(str, shape))} numbers"


state("scale-not-a-number", "scale must be a number")


@message(example={"name": "provenance"})
def field_not_text(name: str) -> str:
    return f"{name} must be a string"


@message(example={"model": 0, "numbers": (1, 2)})
def joined_of_models(model: int, numbers: Sequence[int]) -> str:
    return (
        f"model {model} was joined from the models {', '.join(map(str, numbers))} and cannot be split again: "
        "the original project is unchanged; --join off keeps its models apart"
    )


@message(advice="give each as NUMBER=FILE", example={"source": "scale.json"})
def two_scales_for_one_model(source: str) -> str:
    return f"{source}: two scales for one model"


state("models-without-index", "models: each needs an index")

state("fragments-without-index", "fragments: each needs a colmap_index")

state("not-a-scale-estimate", "not a scale estimate (as colmap-inertial scale --json writes it)")


@message(example={"names": ("metres_per_unit", "sigma_log")})
def fields_not_numbers(names: Sequence[str]) -> str:
    return f"{' and '.join(names)} must be numbers or null"


state("reasons-not-texts", "reasons must be a list of strings")


@message(example={"verdict": "good"})
def verdict_unknown(verdict: object) -> str:
    return f"unknown verdict {verdict!r}"


@message(example={"detail": "ci95 must be two numbers"})
def scale_estimate_invalid(detail: str) -> str:
    return f"not a valid scale estimate: {detail}"


state(
    "gravity-of-scale-missing",
    "gravity_in_world_m_s2 is missing",
    advice="give the number with --factor to scale alone",
    joint=": ",
)

state("rotations-not-names", "rotations: left_out, registered_again and joined must be lists of image names")

state("of-model-unreadable", "of_model does not state the model of the scale")


@message(advice="give one for each, --scale NUMBER=FILE", joint=": ", example={"project": "project", "numbers": (0, 1)})
def scale_for_each_submodel(project: str, numbers: Sequence[int]) -> str:
    return f"{project} has the sub-models {', '.join(map(str, numbers))}, each with a scale of its own"


@message(example={"project": "project", "numbers": (0, 1), "given": (2,)})
def scales_of_other_submodels(project: str, numbers: Sequence[int], given: Sequence[int]) -> str:
    return (
        f"{project} has the sub-models {', '.join(map(str, numbers))}, but there are scales of "
        f"{', '.join(map(str, given))}"
    )
