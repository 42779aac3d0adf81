"""What the description of a target, and lengths and points that are measured with it, lack."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state

#: What the fields of each kind mean.
_FIELDS = {
    "checkerboard": "COLSxROWS counts inner corners, as in checkerboard:9x6:0.025",
    "charuco": "COLSxROWS counts squares, as in charuco:7x5:0.04:0.03:DICT_4X4_50",
    "aprilgrid": "COLSxROWS counts tags, GAP is the gap between tags divided by the tag's side, as in "
    "aprilgrid:6x6:0.088:0.3",
    "aruco": "SIDE_M is the side of the black square, as in aruco:DICT_4X4_50:0.1",
}


def _list_measured(measured: Sequence[int]) -> str:
    return f"those that were: {', '.join(map(str, measured))}" if measured else "no marker was"


# how a target is described


@message(
    example={
        "spec": "aruco:X:0.1",
        "why": {"code": "dictionary-unknown", "values": {"text": "X", "known": ("4X4_50",)}},
        "kind": "aruco",
        "forms": ("aruco:DICT:SIDE_M",),
    }
)
def target_unreadable(spec: str, why: Said, kind: str | None, forms: Sequence[str]) -> str:
    note = "" if kind is None else f" ({_FIELDS[kind]})"
    return f'target "{spec}": {why}; expected ' + " or ".join(forms) + note


@message(example={"kind": "chess"})
def target_kind_unknown(kind: str) -> str:
    return f'unknown kind of target "{kind}"'


@message(example={"found": 2, "kind": "checkerboard", "wanted": 3})
def target_fields(found: int, kind: str, wanted: int) -> str:
    return f"{found} fields after {kind}, not {wanted}"


@message(example={"marker_m": 0.05, "square_m": 0.04})
def marker_larger_than_square(marker_m: float, square_m: float) -> str:
    return f"the marker ({marker_m} m) must be smaller than the square ({square_m} m)"


@message(example={"gap": 1.5})
def gap_out_of_range(gap: float) -> str:
    return f"GAP is {gap}: the gap divided by the tag's side lies between 0 and 1"


state("sigma-of-another-length", "+- belongs to the side of a square, tag or marker")


@message(example={"sigma_m": 0.1})
def sigma_too_large(sigma_m: float) -> str:
    return f"+- {sigma_m:g} m is more than a fifth of the length"


@message(example={"name": "SIDE_M", "text": "x"})
def not_a_number_in_target(name: str, text: str) -> str:
    return f'{name} is "{text}", not a number'


@message(example={"name": "SIDE_M", "text": "-1"})
def length_not_positive(name: str, text: str) -> str:
    return f"{name} is {text}: a length must be positive"


@message(example={"name": "SIDE_M", "text": "100", "value": 100.0})
def length_in_millimetres(name: str, text: str, value: float) -> str:
    return f"{name} is {text}: lengths are metres, so {text} mm is {value / 1000:g}"


@message(example={"text": "9"})
def board_size_unreadable(text: str) -> str:
    return f'COLSxROWS is "{text}", not two whole numbers with an x between them'


@message(example={"text": "2x200", "least": 3})
def board_size_out_of_range(text: str, least: int) -> str:
    return f"COLSxROWS is {text}: each must be from {least} to 100"


@message(example={"text": "5X5", "known": ("4X4_50",)})
def dictionary_unknown(text: str, known: Sequence[str]) -> str:
    return f'unknown dictionary "{text}" (known: {", ".join(known)})'


@message(example={"markers": 100, "name": "4X4_50", "has": 50})
def dictionary_too_small(markers: int, name: str, has: int) -> str:
    return f"needs {markers} markers, and {name} has {has}"


# markers and points


@message(example={"length_m": -1.0})
def bar_not_positive(length_m: float) -> str:
    return f"length_m must be positive, not {length_m:g}"


@message(example={"path": "points.csv", "count": 2, "needed": 3})
def check_points_too_few(path: str, count: int, needed: int) -> str:
    return f"{path} has {count} check points; {needed} at different places are needed"


@message(example={"target": "aruco:4X4_50:0.1"})
def corners_of_target_too_few(target: str) -> str:
    return f"too few corners of {target} were measured to find its centre"


@message(example={"marker": 3, "measured": (1, 2)})
def marker_of_distance_not_measured(marker: int, measured: Sequence[int]) -> str:
    return f"marker {marker} was not measured; {_list_measured(measured)}"


@message(example={"column": "x", "needed": ("marker", "x", "y", "z")})
def column_of_table_missing(column: str, needed: Sequence[str]) -> str:
    return f"has no column {column}; expected {','.join(needed)} and, where known, sigma_m"


@message(example={"column": "x", "text": "a"})
def cell_of_table_not_a_number(column: str, text: str) -> str:
    return f'{column} is "{text}", not a number'


@message(example={"marker": "3", "measured": ()})
def marker_of_table_not_measured(marker: str, measured: Sequence[int]) -> str:
    return f"marker {marker} was not measured in the model; {_list_measured(measured)}"


# its place in the model

state("target-behind-camera", "the fit places the target behind a camera that sees it")


@message(example={"count": 5, "unknowns": 9})
def corners_too_few(count: int, unknowns: int) -> str:
    return f"{count} corner observations are too few for {unknowns} unknowns"


state("target-fit-unsettled", "the fit of the target does not converge; the views may be too close together")

state("image-gone", "the image can no longer be read")

state("picture-not-written", "the image cannot be written")


@message(advice="give one of them", joint=": ", example={"folders": ("0", "1")})
def models_in_folders(folders: Sequence[str]) -> str:
    return f"holds models in its folders {', '.join(folders)}"


state("not-a-folder-of-images", "not a folder", advice="give the folder with the model's images", joint=": ")

state("no-image-with-pose", "holds no image with a pose")


@message(advice="names must match", example={"count": 10, "first": "a.jpg"})
def images_of_model_missing(count: int, first: str) -> str:
    return f"holds none of the model's {count} images (the first would be {first})"
