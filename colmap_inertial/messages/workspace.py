"""Models and workspaces that other programs made."""

from __future__ import annotations

from colmap_inertial.messages import Said, message, state


def _of(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


@message(example={"found": {"code": "git-lfs-pointer", "values": {}}})
def noted_with_advice(found: Said) -> str:
    return found.with_advice


@message(example={"path": "log.csv", "line": 7, "why": {"code": "zeros", "values": {}}})
def wrong_in_file(path: str, line: int | None, why: Said) -> str:
    return f"{path}{'' if line is None else f', line {line}'}: {why.with_advice}"


@message(example={"file": "sparse/0/images.txt", "found": {"code": "zeros", "values": {}}})
def read_all_the_same(file: str, found: Said) -> str:
    return f"{file}: {found.with_advice}"


# files that are none

message(
    code="git-lfs-pointer",
    advice="run git lfs pull there, or leave it out with --keep or by moving it away",
)(lambda: "is a Git LFS pointer: the file itself is not in this clone")
message(code="git-annex-pointer", advice="run git annex get there, or move it away")(
    lambda: "is a git-annex pointer: the file itself is not in this clone"
)
state(
    "apple-double",
    "is a macOS metadata file (AppleDouble), not the file itself",
    advice="remove it: find . -name '._*' -delete",
)
state(
    "web-page",
    "is a web page, probably saved in place of the file by a download without access",
    advice="download it again",
)
state("zeros", "holds only zeros, probably from an interrupted copy or download", advice="copy it again")


@message(advice="unpack it first", example={"kind": "gzip"})
def packed_file(kind: str) -> str:
    return f"is packed ({kind})"


@message(advice="convert it to PNG or JPEG", example={"kind": "HEIF or AVIF"})
def picture_format(kind: str) -> str:
    return f"is a {kind} image, a format that is not supported"


# models


@message(example={"count": 3, "points": 2})
def lost_points(count: int, points: int) -> str:
    return (
        f"{_of(count, 'keypoint')} {'refers' if count == 1 else 'refer'} to {_of(points, 'point')} that the "
        f"model lacks "
        "or that do not refer back: read as keypoints without a point"
    )


@message(example={"count": 3})
def lost_observations(count: int) -> str:
    return f"{_of(count, 'entry' if count == 1 else 'entrie')} of points' tracks refer to missing keypoints: left out"


@message(example={"count": 30})
def tracks_from_images(count: int) -> str:
    return f"the points have no tracks: these are taken from the {count} keypoints that refer to them"


@message(example={"count": 3, "frames": 1})
def lost_images(count: int, frames: int) -> str:
    return f"frames refer to {_of(count, 'image')} that the model lacks: left out"


@message(example={"stated": 12, "found": 10, "what": "images"})
def other_count(stated: int, found: int, what: str) -> str:
    return f"its header states {stated} {what}, but it holds {found}: was the file cut off or edited?"


@message(example={"count": 10})
def images_without_second_line(count: int) -> str:
    return f"{_of(count, 'image')} lack{'s' if count == 1 else ''} the second line, of keypoints: read as empty"


@message(example={"count": 10})
def decimal_commas(count: int) -> str:
    return f"{_of(count, 'line')} with commas among the numbers: read as decimal commas, or as separators"


@message(
    advice="names must be unique: rename them in the program that made the model (some readers of text models cut "
    "names at blanks)",
    example={"count": 10, "name": "A-DJI_2024"},
)
def repeated_name(count: int, name: str) -> str:
    return f"{count} images have the name {name!r}"


@message(advice="the file is damaged or was merged from two models", example={"what": "image", "number": 3})
def repeated_number(what: str, number: int) -> str:
    return f"{what} {number} appears twice"


@message(advice="write the model again with the program that made it", example={"image": "a.jpg", "camera": 3})
def unknown_camera(image: str, camera: int) -> str:
    return f"its image {image!r} is of camera {camera}, which the model lacks"


@message(example={"expects": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "text": "1, 2"})
def text_line(expects: str, text: str) -> str:
    return f"expected {expects}, found {text!r}"


@message(
    advice="rays beyond it are not used; a lens model with more terms fits wide lenses",
    example={"camera": 1, "model": "SIMPLE_RADIAL", "radius_px": 310.0, "corner_px": 400.0},
)
def folded_lens(camera: int, model: str, radius_px: float, corner_px: float) -> str:
    return (
        f"the distortion of camera {camera} ({model}) is not invertible beyond {radius_px:.0f} px from the "
        f"centre, and its "
        f"images reach {corner_px:.0f} px"
    )


@message(
    advice="its parameters may be for another image size",
    example={"camera": 1, "width": 640, "height": 480, "cx": 1280.0, "cy": 960.0},
)
def odd_principal_point(camera: int, width: int, height: int, cx: float, cy: float) -> str:
    return f"the principal point of camera {camera}, {cx:.0f}, {cy:.0f}, is outside its {width} x {height} pixels"


# what an applied similarity leaves as it is


state("file-for-folder", "is a file, not a folder", advice="give the folder that it is in")
state(
    "nothing-to-undo",
    "has no transform.json: nothing was applied here",
    advice="give the folder that apply or reconstruct wrote",
)


@message(example={"names": ("points3D.bin",)})
def model_incomplete(names: tuple[str, ...]) -> str:
    return f"incomplete COLMAP model: {', '.join(names)} {'is' if len(names) == 1 else 'are'} missing"


@message(advice="open the folder there and have it downloaded", example={"names": ("points3D.bin",)})
def kept_in_cloud(names: tuple[str, ...]) -> str:
    return f"incomplete COLMAP model: {', '.join(names)} {'is' if len(names) == 1 else 'are'} in iCloud only"


@message(example={"kinds": ("2 .las", "1 .splat")})
def carried_lengths(kinds: tuple[str, ...]) -> str:
    return f"copied in their old units (formats that are not transformed): {', '.join(kinds)}"


@message(example={"kinds": ("3 .ckpt (outputs/step.ckpt)",)})
def possible_lengths(kinds: tuple[str, ...]) -> str:
    return f"copied unchanged (unknown formats, which may hold lengths): {', '.join(kinds)}"


def _depth_advice(count: int, example: str, factors: tuple[float, ...]) -> str:
    if len(factors) != 1:
        return ""
    return f"nerfstudio's --depth-unit-scale-factor (0.001 by default) becomes {factors[0]:.9g} times as large"


@message(advice=_depth_advice, example={"count": 10, "example": "depth/frame_00001.png", "factors": (2.5,)})
def unmoved_depths(count: int, example: str, factors: tuple[float, ...]) -> str:
    times = (
        f"{factors[0]:.9g} times its former length"
        if len(factors) == 1
        else "its former length times its model's scale"
    )
    return f"depths in {_of(count, 'integer image')} ({example}) are unchanged: one step is now {times}"


@message(
    advice="nothing to do if it is already in metres",
    example={"path": "rig_config.json", "ratio": 2.5},
)
def rig_elsewhere(path: str, ratio: float | None) -> str:
    if ratio is None:
        return f"{path}: copied unchanged, as no model here has images of its cameras"
    return f"{path}: copied unchanged, as its cameras are {ratio:.4g} times as far apart as in the model"


@message(
    advice="check whether they are lengths",
    example={"path": "transforms.json", "fields": ("aabb", "scene_radius")},
)
def fields_unmoved(path: str, fields: tuple[str, ...]) -> str:
    return f"{path}: {', '.join(fields)} are unchanged, as their meaning is unknown"


@message(example={"path": "outputs/dataparser_transforms.json"})
def training_of_another_model(path: str) -> str:
    return f"{path}: copied unchanged, as it does not transform a model here to nerfstudio's cameras"


@message(example={"path": "exports/splat.ply", "by": "outputs/dataparser_transforms.json"})
def frame_of_training(path: str, by: str) -> str:
    return f"{path}: copied unchanged, as its points are in the frame of a training run; {by} transforms metres to it"


@message(example={"path": "transforms.json"})
def cameras_elsewhere_in_file(path: str) -> str:
    return f"{path}: copied unchanged, as its cameras are not those of a model"


@message(
    advice="look at it, or leave it out with --keep",
    example={"path": "exports/splat.ply", "share_pct": 40.0},
)
def other_frame(path: str, share_pct: float) -> str:
    return (
        f"{path}: transformed with the model, although its points are {share_pct:.0f} % of the model's size "
        f"away from the "
        "model's: it may be in another frame"
    )


@message(example={"path": "sparse_pc.ply", "by": "transforms.json"})
def frame_of_transforms(path: str, by: str) -> str:
    return f"{path} is in the world frame of {by}, and transformed in it"


@message(advice="a pattern is a name, or a path in the project", example={"pattern": "old"})
def idle_pattern(pattern: str) -> str:
    return f"--keep {pattern} matches no path of the project"


@message(
    advice="rename it, or move it out of the project",
    example={"provenance": ""},
)
def foreign_record(provenance: str = "") -> str:
    return "is not a record of colmap-inertial, which writes its own under this name"


# where a model lies, and whose scale it is given


@message(example={"folder": "sparse/0", "pivot": (432100.0, 5664700.0, 120.0)})
def about_place(folder: str, pivot: tuple[float, ...]) -> str:
    return f"{folder} lies far from the origin: it is rotated and scaled about {', '.join(f'{x:.9g}' for x in pivot)}"


@message(
    advice="leave out --dense, and make the cloud from an export, which is centred",
    example={"folder": "project/sparse/0"},
)
def dense_far_away(folder: str) -> str:
    return f"{folder} lies far from the origin, and dense clouds have single precision"


@message(
    advice="a translation_m of p - s R p does that about a point p",
    example={"folder": "sparse/0", "distance": 28000.0},
)
def moved_away(folder: str, distance: float) -> str:
    return f"{folder} lies far from the origin, so the similarity moves it by {distance:.6g}"


@message(
    advice="estimate this model's own scale; --any-model applies it anyway",
    example={"folder": "sparse/0", "difference": "12 images instead of 10"},
)
def scale_of_another_model(folder: str, difference: str) -> str:
    return f"the scale is of another model than {folder}: {difference}"


@message(example={"difference": "12 images instead of 10"})
def scale_taken_all_the_same(difference: str) -> str:
    return f"the scale is of another model ({difference}), applied anyway"


state("scale-without-identity", "the scale does not name its model: it is assumed to be this one")


# exports


@message(example={"offset": (432100.0, 5664700.0, 120.0)})
def recentred(offset: tuple[float, ...]) -> str:
    where = ", ".join(f"{x:.9g}" for x in offset)
    return (
        f"the model lies too far from the origin for single precision: {where} is subtracted from all coordinates, and "
        "written to metadata.xml (SRSOrigin) and export.json"
    )


@message(example={"folder": "project/masks"})
def masks_left(folder: str) -> str:
    return f"the masks in {folder} belong to the distorted images and are not exported"


@message(example={"direction": "up"})
def no_row_poses(direction: str) -> str:
    return f"these images are read out {direction}: viewmats_rs.json, for rows from the top, is not written"


# targets


def _contradiction_advice(
    kind: str,
    gap: float,
    lengths_mm: tuple[float, ...],
    off_pct: tuple[float, ...],
    along: tuple[str, ...],
    likely_gap: float | None = None,
) -> str:
    if kind == "aprilgrid":
        likely = "" if likely_gap is None else f"; the images show {likely_gap:.3g}"
        return (
            f"check the gap, which is {gap:g} in its description: the distance between two tags divided by a tag's "
            f"side{likely}"
        )
    return "check its columns, rows and sizes, that it is flat, and that it was printed without distortion"


@message(
    advice=_contradiction_advice,
    example={
        "kind": "aprilgrid",
        "gap": 0.25,
        "lengths_mm": (10.0, 40.0),
        "off_pct": (16.0, -3.6),
        "along": ("row", "column"),
        "likely_gap": 0.3,
    },
)
def lengths_contradict(
    kind: str,
    gap: float,
    lengths_mm: tuple[float, ...],
    off_pct: tuple[float, ...],
    along: tuple[str, ...],
    likely_gap: float | None = None,
) -> str:
    listed = ", ".join(
        f"{length:.4g} mm in a {line} {off:+.{0 if abs(off) >= 100 else 1}f} %"
        for length, off, line in zip(lengths_mm, off_pct, along, strict=True)
    )
    return f"its lengths contradict each other systematically: {listed}"
