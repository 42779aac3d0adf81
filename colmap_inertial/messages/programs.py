"""What the command line, networks, the viewer and exports refuse."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_existing, say_missing

_MORE_MEMORY = {
    "cuda": "if memory is short, close other programs that use the GPU, or hide it (CUDA_VISIBLE_DEVICES=) to "
    "use the processor",
    "cpu": "if memory is short, free some: each image in progress takes about half a gigabyte",
}


_AGAIN = "install colmap-inertial again"


# the command line

state("gravity-is-of-rests", "latitude and height are for recordings of rests only; leave them out with results")


@message(
    example={
        "source": "log.csv",
        "found": {
            "code": "table-unclear",
            "values": {"why": {"code": "no-header-of-columns", "values": {}}, "header": None, "hint": "[imu.gyro]"},
        },
    }
)
def table_described_above(source: str, found: Said) -> str:
    return f"{source}: {found}; the capture.toml above describes it"


# networks and apertures


@message(example={"missing": ("green",), "apertures": ("A (red)", "B (blue)")})
def colours_missing(missing: Sequence[str], apertures: Sequence[str]) -> str:
    return (
        f"fused images need a red, a green and a blue aperture; {', '.join(missing)} is missing among "
        f"{', '.join(apertures)}"
    )


@message(example={"network": "lsd2", "device": "cuda", "detail": "out of memory"})
def network_failed(network: str, device: str, detail: str) -> str:
    return f"the network {network} failed on {device} ({detail}); {_MORE_MEMORY[device]}"


state(
    "onnxruntime-without-cuda",
    "this onnxruntime has no CUDA",
    advice="install onnxruntime-gpu in place of onnxruntime, or use the processor",
    joint=": ",
)


@message(example={"network": "lsd2"})
def cuda_not_usable(network: str) -> str:
    return f"{network} cannot run on CUDA: onnxruntime found no device, or lacks CUDA or cuDNN"


@message(example={"detail": "Protobuf parsing failed"})
def not_a_network(detail: str) -> str:
    return f"onnxruntime cannot read it as a network ({detail})"


@message(
    example={
        "takes": ("x tensor(float)",),
        "gives": ("y",),
        "wanted_takes": ("picture", "aid", "blur"),
        "wanted_gives": "restored",
    }
)
def wrong_network(takes: Sequence[str], gives: Sequence[str], wanted_takes: Sequence[str], wanted_gives: str) -> str:
    return (
        f"has the inputs {', '.join(takes)} and the outputs {', '.join(gives)}; a network that restores images has "
        f"the inputs {', '.join(wanted_takes)}, all tensor(float), and the output {wanted_gives}"
    )


@message(example={"width": 48, "height": 32, "detail": "shapes do not match"})
def network_does_not_run(width: int, height: int, detail: str) -> str:
    return f"does not run on {width} x {height} px ({detail})"


@message(advice="an image must keep its size", example={"made": (1, 3, 16, 24), "given": (1, 3, 32, 48)})
def network_changes_size(made: Sequence[int], given: Sequence[int]) -> str:
    return f"returns {made} for an input of {given}"


@message(advice=_AGAIN, example={"network": "lsd2"})
def checksums_missing(network: str) -> str:
    return f"is missing, and with it the network {network}"


@message(advice=_AGAIN, example={"network": "lsd2"})
def checksum_unstated(network: str) -> str:
    return f"does not name the network {network}"


state("network-missing", "is missing", advice=_AGAIN)


@message(advice=_AGAIN, example={"size_bytes": 1000})
def network_damaged(size_bytes: int) -> str:
    return f"is damaged ({size_bytes} bytes, not those of its checksum)"


# exports

state("no-smoothed-path", "has no smoothed path, which only a run of reconstruct with a scale makes; csv needs none")

state("frames-of-several-pictures", "its frames are fused from several images each: there is no original")


@message(example={"frame": "0007.jpg"})
def frame_not_in_capture(frame: str) -> str:
    return f"has no frame {frame!r}: it is not the capture of this run"


state(
    "changed-since-its-run",
    "was changed since its run: run it again to restore it, or give the images by --image-folder",
)


@message(advice="give its folder with --image-folder", example={"image": "0007.jpg", "folders": ("images",)})
def picture_missing(image: str, folders: Sequence[str]) -> str:
    return f"the file of its image {image!r} is missing (in {', '.join(folders) or 'no folder of images'})"


@message(advice="--unscaled exports it in its own units", example={"reasons": ("the camera hardly accelerates",)})
def export_without_scale(reasons: Sequence[str]) -> str:
    return "; ".join(map(str, reasons))


state("nowhere-on-earth", "only a metric model with known gravity can be georeferenced")

state("pictures-not-beside", "its images are not beside it", advice="give --capture or --image-folder", joint=": ")

state("times-of-images-lost", "the run kept no times of its images, which positions in a video need")

state("no-velocities", "none of the model's images has a velocity")

state(
    "velocities-not-kept",
    (
        "the run kept no velocities: its model has no scale, its gyroscope recorded nothing, or an earlier version "
        "made it (then start reconstruct again with the same arguments, which adds them)"
    ),
)


@message(advice="export the rectified ones, or rotate the images", example={"direction": "up"})
def readout_not_told(direction: str) -> str:
    return f"these images are read out in the direction {direction}, which the program does not support"


@message(example={"camera": 1, "model": "SPHERICAL"})
def sees_all_around(camera: int, model: str) -> str:
    return f"camera {camera} ({model}) is a panoramic camera, not a pinhole camera"


@message(example={"camera": 1, "model": "OPENCV"})
def not_undistorted(camera: int, model: str) -> str:
    return f"camera {camera} ({model}): its lens cannot be undistorted"


@message(example={"width": 640, "height": 480, "camera_width": 1920, "camera_height": 1080})
def picture_of_another_size(width: int, height: int, camera_width: int, camera_height: int) -> str:
    return (
        f"has {width} x {height} pixels, its camera {camera_width} x {camera_height}: it is not an image of this model"
    )


@message(advice="choose a folder elsewhere", example={"folder": "project", "out": "project/export"})
def folders_within_each_other(folder: str, out: str) -> str:
    return f"one of {folder} and {out} lies within the other"


# batches and simulations

state("no-folder-with-capture", "holds no folder with a capture")
state(
    "batch-of-one-capture",
    "is a capture itself (capture.toml)",
    advice="give the folder that holds the captures, or use reconstruct",
)
state("manifest-without-capture", "names no capture", advice="write [[capture]] tables", joint=": ")
state("capture-not-in-tables", "write [[capture]], with two brackets, before each capture")


@message(example={"key": "options"})
def key_is_a_table(key: str) -> str:
    return f"is a table, such as {key}.name = value"


@message(example={"found": 1.5})
def not_a_whole_number(found: float) -> str:
    return f"must be a whole number, found {found!r}"


@message(advice="choose a new one", example={"out": "out"})
def not_a_batch(out: str) -> str:
    return f"{out} is not the folder of a batch"


@message(example={"out": "out", "detail": "Permission denied"})
def folder_not_made(out: str, detail: str) -> str:
    return f"{out} cannot be created: {detail}"


@message(advice="give one another name", joint=": ", example={"name": "walk", "first": "a/walk", "second": "b/walk"})
def captures_of_one_name(name: str, first: str, second: str) -> str:
    return f"two captures are called {name} ({first}, {second})"


@message(
    advice="check it first, then allow it with --allow-stages (allow_stages=True)",
    example={"number": 1, "code": ("my_stages:sharpen",)},
)
def batch_names_code(number: int, code: Sequence[str]) -> str:
    return f"[capture, number {number}] stages: names code that this batch would run ({', '.join(code)})"


state(
    "stages-before-a-model",
    "stages.frame and stages.keypoint: an existing model is not mapped again, nor its images changed; "
    "give this capture stages of its own without them",
)

state("not-a-result", "is not the result of a reconstruction")


def _advise_on_path(low_m: Sequence[float], high_m: Sequence[float], **_: float) -> str:
    low, high = ("(" + ", ".join(f"{value:g}" for value in corner) + ")" for corner in (low_m, high_m))
    return (
        "set start_m and heading_deg, a shorter duration_s or a lower speed_m_s under [motion]; the room reaches from "
        f"{low} to {high} m"
    )


@message(
    advice=_advise_on_path,
    example={
        "first_s": 4.2,
        "outside": 83,
        "frames": 100,
        "low_m": (-3.2, -2.8, -1.4),
        "high_m": (3.2, 2.8, 1.3),
    },
)
def path_leaves_room(first_s: float, outside: int, frames: int, low_m: Sequence[float], high_m: Sequence[float]) -> str:
    return f"the camera leaves the room: it is outside in {outside} of {frames} frames, first at {first_s:.1f} s"


@message(advice="name a new folder", example={"folder": "scene"})
def folder_exists(folder: str) -> str:
    return say_existing(folder)


# how a capture of a batch ended


@message(
    advice="workers need the same files under the same paths",
    joint=": ",
    example={"worker": "host", "path": "out/walk.toml"},
)
def worker_sees_no_files(worker: str, path: str) -> str:
    return f"{worker} cannot access {path}"


@message(advice=lambda log, **_: f"see {log}", example={"times": 3, "log": "out/walk.log"})
def capture_killed(times: int, log: str) -> str:
    return f"its process or worker was killed {times} times"


@message(advice=lambda log, **_: f"see {log}", example={"exit_code": 1, "log": "out/walk.log"})
def capture_process_ended(exit_code: int, log: str) -> str:
    return f"its process ended with code {exit_code}"


@message(example={"kind": "KeyError", "detail": "'a'", "log": "out/walk.log"})
def unexpected_error(kind: str, detail: str, log: str) -> str:
    return f"{kind}: {detail} (see {log})"


@message(example={"detail": "KilledWorker: walk"})
def no_worker_finished(detail: str) -> str:
    return f"no worker could finish it: {detail}"


# the viewer

state("mesh-without-faces", "a mesh without faces")

state("faces-with-more", "the faces of this mesh have properties besides their lists of vertices")

state("mesh-truncated", "truncated, or a mesh with faces other than triangles")

state("faces-not-triangles", "a mesh with faces other than triangles")


state("ply-not-shown", "only binary PLY files that begin with vertices can be shown")

state("holds-no-points", "holds no points")

state("nothing-to-view", say_missing("folder"), advice="give what reconstruct or apply wrote, or a COLMAP model")

state("no-folder-of-images", say_missing("folder of images"))

state(
    "run-not-finished",
    "the run that writes this folder is not finished",
    advice="start it again with the same arguments; it continues",
)


@message(advice="run it again", example={"detail": "result.json: no models"})
def result_damaged(detail: str) -> str:
    return f"its result is damaged ({detail})"


state("result-without-model", "its result holds no model to show")


@message(
    advice=lambda project: f"give the project that it is of ({project})",
    joint=": ",
    example={"project": "/data/project"},
)
def result_without_own_model(project: str) -> str:
    return "has no model of its own, as its scale was refused"


state(
    "neither-result-nor-model",
    "neither a result of colmap-inertial nor a COLMAP model here (cameras, images, points3D, .bin or .txt)",
)


@message(
    advice=lambda target: f"give {target} as --images (export: --image-folder)", example={"target": "/data/images"}
)
def link_out_of_project(target: str) -> str:
    return "is a link out of the project"


@message(
    advice=lambda numbers, **_: f"--model takes one of {', '.join(map(str, numbers))}",
    example={"number": 3, "numbers": (0, 1)},
)
def no_such_model(number: int, numbers: Sequence[int]) -> str:
    return f"no model {number} here"
