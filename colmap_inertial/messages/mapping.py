"""What COLMAP, its settings, its workers and the folder of a run refuse."""

from __future__ import annotations

from collections.abc import Sequence

from colmap_inertial.messages import Said, message, state
from colmap_inertial.messages.shared import say_missing


def _give_pose(camera: str, **_: object) -> str:
    return f"give cam_from_reference under [rig.{camera}], or a calibration of all cameras under [rig]"


def _did_you_mean(nearest: str | None) -> str:
    return "" if nearest is None else f"; did you mean {nearest}?"


# an installed COLMAP


@message(example={"setting": "Mapper.x=1", "version": "3.9", "program": "/usr/bin/colmap", "nearest": None})
def not_an_option_of_colmap(setting: str, version: str, program: str, nearest: str | None) -> str:
    return f"--colmap {setting}: COLMAP {version} ({program}) has no such option{_did_you_mean(nearest)}"


state(
    "colmap-executable-missing",
    say_missing("file"),
    advice="--colmap-executable takes the path of COLMAP's program (`which colmap`)",
    joint=": ",
)

state(
    "colmap-executable-not-to-run",
    "is not executable",
    advice="make it executable (chmod +x), or give COLMAP's program",
    joint=": ",
)

state(
    "deterministic-without-pycolmap",
    "--deterministic works with pycolmap only: an installed COLMAP may find other features and matches "
    "each time (3.8 does)",
    advice="leave --colmap-executable out",
)


@message(
    advice=(
        "leave --colmap-executable out, or find and match features with it yourself, and give its database "
        "with --database"
    ),
    joint=": ",
    example={"features": "aliked"},
)
def features_without_pycolmap(features: str) -> str:
    return f"--mapping.features {features} works with pycolmap only"


@message(example={"printed": "usage: x"})
def not_colmap(printed: str) -> str:
    return f"is not COLMAP: `help` prints {printed!r}"


@message(advice="leave it out", example={"program": "/usr/bin/colmap"})
def colmap_without_cuda(program: str) -> str:
    return f"--mapping.device cuda: {program} is built without CUDA"


@message(example={"version": "3.6", "command": "mapper", "options": ("--x",)})
def colmap_lacks_options(version: str, command: str, options: Sequence[str]) -> str:
    return f"COLMAP {version}: its {command} has no {', '.join(options)}, needed here"


@message(advice="give COLMAP's program", example={"detail": "Exec format error"})
def program_not_run(detail: str) -> str:
    return f"cannot be run: {detail}"


@message(example={"program": "/usr/bin/colmap", "version": "3.9", "detail": "no such table: rigs"})
def database_not_usable_here(program: str, version: str, detail: str) -> str:
    return f"{program} (COLMAP {version}): its database cannot be used here: {detail}"


@message(example={"program": "/usr/bin/colmap", "image": "0007.jpg", "others": 3})
def features_missing(program: str, image: str, others: int) -> str:
    return f"{program}: no features were written for {image} and {others} other images"


state(
    "executable-with-scheduler",
    "--colmap-executable: an installed COLMAP works on this machine only",
    advice="leave out --scheduler",
)


@message(
    example={
        "program": "/usr/bin/colmap",
        "command": "mapper",
        "version": "3.9",
        "exit_code": 1,
        "output": ("no images",),
        "log": "out/colmap.log",
    }
)
def colmap_failed(program: str, command: str, version: str, exit_code: int, output: Sequence[str], log: str) -> str:
    what = f"was killed (signal {-exit_code})" if exit_code < 0 else f"failed with exit code {exit_code}"
    printed = " | ".join(output) or "it printed nothing"
    return f"{program} {command} (COLMAP {version}) {what}: {printed}; full output in {log}"


@message(example={"program": "/usr/bin/colmap", "why": {"code": "database-damaged", "values": {}}})
def written_database_unusable(program: str, why: Said) -> str:
    return f"{program}: the database that it wrote cannot be used: {why}"


# COLMAP's own work

state(
    "no-model-found",
    "COLMAP found no model: too few matches between the frames. Film with more overlap, more texture "
    "or less blur, or try --mapping.pairing exhaustive",
)

state("database-damaged", "damaged")


@message(example={"path": "images"})
def file_unseen(path: str) -> str:
    return f"{path} is not visible here"


@message(example={"path": "images/0007.jpg"})
def image_unread(path: str) -> str:
    return f"COLMAP could not read {path}"


@message(advice="free some space and start again; the run continues", example={"database": "database.db"})
def database_not_written(database: str) -> str:
    return (
        f"{database}: COLMAP cannot write its database here: the disk is full, or a quota, a limit of file "
        "sizes or of open files (ulimit -n) is reached"
    )


state(
    "pycolmap-without-cuda",
    "--mapping.device cuda: this pycolmap is built without CUDA",
    advice="install pycolmap-cuda12, or leave it out",
)

state(
    "pycolmap-without-onnx",
    "--mapping.features aliked: this pycolmap is built without ONNX, as the published wheels are",
    advice="find and match features with a COLMAP that has it, and give its database with --database",
)


@message(
    advice=lambda options: f"give the networks by {' and '.join(f'--colmap {name}=FILE' for name in options)}",
    example={"options": ("AlikedExtraction.n16rot_model_path",)},
)
def networks_not_named(options: Sequence[str]) -> str:
    return "--mapping.features aliked: nothing is downloaded"


state("name-not-for-pairs", "COLMAP's lists of pairs cannot hold such a file name", advice="rename it without spaces")

# a database that is given


@message(
    advice="give a database of the capture's images, with their names",
    joint=": ",
    example={"count": 3, "of": 10, "image": "x.jpg", "expected": "a.jpg"},
)
def images_of_another_capture(count: int, of: int, image: str, expected: str) -> str:
    return f"{count} of its {of} images are not the capture's ({image}; the capture has {expected})"


@message(
    advice="give a database of the images in their own size",
    joint=": ",
    example={"image": "a.jpg", "width": 640, "height": 480, "capture_width": 1920, "capture_height": 1080},
)
def given_image_of_another_size(image: str, width: int, height: int, capture_width: int, capture_height: int) -> str:
    return f"{image} is {width}x{height} there and {capture_width}x{capture_height} in the capture"


state("no-given-database", say_missing("file"), advice="--database takes a COLMAP database", joint=": ")

state(
    "database-in-use", "another program has it open, or was stopped while writing", advice="close it there", joint=": "
)


@message(example={"detail": "row 3 missing from index"})
def database_check_failed(detail: str) -> str:
    return f"damaged: {detail}"


@message(example={"table": "images"})
def no_colmap_database(table: str) -> str:
    return f"is no COLMAP database: it has no table {table}"


state("image-without-camera", "damaged: an image has no camera")


@message(example={"count": 3, "table": "keypoints"})
def rows_of_other_length(count: int, table: str) -> str:
    return f"damaged: {count} rows of {table} do not have their stated length"


state("no-keypoints", "holds no keypoints", advice="extract features first, or leave --database out", joint=": ")

state(
    "matches-missing",
    "holds no matches, and descriptors that pycolmap cannot match here (it matches COLMAP's own SIFT)",
    advice="match the pairs with the program that made them",
    joint=": ",
)


@message(example={"first": "a.jpg", "second": "b.jpg"})
def matches_of_missing_keypoints(first: str, second: str) -> str:
    return f"damaged: matches of {first} and {second} name keypoints that do not exist"


# dense reconstruction


@message(example={"folder": "dense/0", "count": 3, "of": 10, "image": "0007.jpg"})
def images_not_undistorted(folder: str, count: int, of: int, image: str) -> str:
    return f"{folder}: COLMAP could not undistort {count} of {of} images ({image})"


state("picture-of-model-missing", "no such image, but the model has it", advice="give the folder of its images")


@message(example={"width": 640, "height": 480, "camera_width": 1920, "camera_height": 1080})
def picture_unlike_its_camera(width: int, height: int, camera_width: int, camera_height: int) -> str:
    return f"is {width}x{height}, but its camera in the model is {camera_width}x{camera_height}"


@message(
    advice=(
        'remove depth_maps and normal_maps, or, where patch-match made them all, write "maps": "patch-match" there'
    ),
    example={"stereo": "dense/0/stereo", "record": "dense/0/made_from.json"},
)
def maps_of_two_makers(stereo: str, record: str) -> str:
    return f"{stereo} holds maps of COLMAP's patch-match, but {record} says that the plane sweep made them"


@message(
    advice=lambda folder, **_: f"rename or remove {folder}", example={"stereo": "dense/0/stereo", "folder": "dense/0"}
)
def maps_of_another_model(stereo: str, folder: str) -> str:
    return f"{stereo} holds depth maps of another model or other options"


@message(example={"folder": "dense/0", "exit_code": 1, "detail": "out of memory"})
def patch_match_failed(folder: str, exit_code: int, detail: str) -> str:
    return (
        f"{folder}: COLMAP's patch-match ended with code {exit_code}: {detail}. Started again, it continues "
        "with the next depth map"
    )


@message(advice="are disk or memory full?", example={"folder": "dense/0", "detail": "exit code 1"})
def no_mesh_written(folder: str, detail: str) -> str:
    return f"{folder}: COLMAP wrote no mesh ({detail})"


state("normals-of-other-size", "does not have the size of its depth map")


@message(advice="is the disk full?", example={"folder": "dense/0"})
def points_not_written(folder: str) -> str:
    return f"{folder}: COLMAP did not write the fused points"


@message(
    advice="shrink the images (--dense-options.max-image-size), or take --dense-options.mesh poisson",
    example={"path": "mesh.ply", "voxel_m": 0.01},
)
def surface_too_large(path: str, voxel_m: float) -> str:
    return f"{path}: the surface is too large for voxels of {1000 * voxel_m:.1f} mm"


@message(advice="is the disk full?", example={"path": "mesh.ply"})
def mesh_not_written(path: str) -> str:
    return f"{path}: open3d wrote no mesh"


@message(example={"folder": "dense/0"})
def no_depth_maps(folder: str) -> str:
    return f"{folder} has no depth maps: no two images overlap enough at a suitable angle"


# rigs and the gyroscope's bias


@message(advice=_give_pose, example={"camera": "left", "frames": 2})
def rig_frames_too_few_placed(camera: str, frames: int) -> str:
    return (
        f"[rig.{camera}]: only {frames} frames have its image and the main camera's in one model, "
        "too few to find the camera's pose"
    )


@message(example={"camera": "left", "apart_deg": 3.0})
def rig_camera_turns(camera: str, apart_deg: float) -> str:
    return (
        f"[rig.{camera}]: the camera rotates by {apart_deg:.2g} deg against the main one from frame to "
        "frame (median), but cameras of a rig are rigidly mounted and triggered together. Correct the "
        f"times, or {_give_pose(camera)}"
    )


@message(example={"camera": "left", "count": 2})
def rig_of_several_cameras(camera: str, count: int) -> str:
    return f"[rig]: images of {camera or 'the main camera'} have {count} COLMAP cameras"


@message(example={"count": 2})
def pairs_too_few(count: int) -> str:
    return f"{count} pairs of neighbouring images are too few"


state("matches-suit-no-bias", "matches of neighbouring images fit no gyroscope bias")

state("matches-suit-any-bias", "matches of neighbouring images fit any gyroscope bias")

# settings of COLMAP


@message(example={"why": {"code": "stated", "values": {"text": "Mapper.x=1: no such option"}}})
def colmap_setting_wrong(why: Said) -> str:
    return f"--colmap {why}"


@message(example={"detail": "no section headers"})
def no_project_ini(detail: str) -> str:
    return f"is not a project.ini of COLMAP: {detail}"


@message(example={"setting": "Mapper.x"})
def setting_unreadable(setting: str) -> str:
    return f"{setting}: write SECTION.option=value, as in Mapper.init_num_trials=100"


@message(example={"setting": "Maper.x=1", "nearest": "Mapper"})
def no_section_of_colmap(setting: str, nearest: str | None) -> str:
    return f"{setting}: COLMAP has no such section{_did_you_mean(nearest)}"


@message(example={"setting": "Mapper.x=-1", "default": "3"})
def value_refused(setting: str, default: str) -> str:
    return f"{setting}: COLMAP refuses this value (its default is {default})"


@message(example={"setting": "Mapper.x=a", "value": "a", "name": "Mapper.x", "default": "3"})
def value_of_other_type(setting: str, value: str, name: str, default: str) -> str:
    return f"{setting}: {value!r} is not a value of {name} (such as {default})"


@message(example={"name": "Mapper.x", "section": "Mapper"})
def section_not_installed(name: str, section: str) -> str:
    return f"{name}: the installed pycolmap has no {section}"


@message(example={"name": "Mapper.x", "nearest": None})
def no_such_setting(name: str, nearest: str | None) -> str:
    return f"{name}: COLMAP has no such option{_did_you_mean(nearest)}"


@message(example={"option": "mapping"})
def option_is_a_table(option: str) -> str:
    return f"{option} is a table of options"


state("mapping-pairing-chooses", "set by --mapping.pairing")


state("dense-mesh-chooses", "set by --dense-options.mesh")


state("of-colmaps-window", "it is an option of COLMAP's GUI")


state("deterministic-decides", "set by --deterministic")


state("seed-decides", "set by --seed")


state("mapping-device-decides", "set by --mapping.device")


state("mapping-features-decides", "set by --mapping.features")


state("pairs-by-verified-matches", "pairs are judged by their verified matches")


state("capture-says-camera", "the capture assigns images to cameras")


state("run-has-own-files", "the run uses its own files")


@message(example={"setting": "Mapper.random_seed=3", "why": {"code": "seed-decides", "values": {}}})
def setting_not_taken(setting: str, why: Said) -> str:
    return f"{setting}: {why}"


@message(example={"option": "mapping.maper", "nearest": "mapping.mapper", "known": ("mapper", "pairing")})
def unknown_option(option: str, nearest: str | None, known: Sequence[str]) -> str:
    return f"unknown option {option}{_did_you_mean(nearest) or '; known: ' + ', '.join(known)}"


# workers


@message(
    advice="name them in Dask's own configuration (distributed.comm.tls)",
    joint=": ",
    example={"address": "tls://host:8786"},
)
def scheduler_needs_certificates(address: str) -> str:
    return f"{address} needs certificates"


@message(example={"address": "tcp://host:8786", "detail": "timed out"})
def no_scheduler_answers(address: str, detail: str) -> str:
    return f"no Dask scheduler answers at {address}: {detail}"


@message(
    advice=lambda address: f"start one (dask worker {address})", joint=": ", example={"address": "tcp://host:8786"}
)
def scheduler_without_worker(address: str) -> str:
    return f"{address} has no worker"


@message(
    advice="install it there",
    example={"worker": "tcp://host:1", "version": "1.0", "detail": "No module named 'colmap_inertial'"},
)
def worker_without_us(worker: str, version: str, detail: str) -> str:
    return f"worker {worker} cannot use colmap-inertial {version}: {detail}"


@message(advice="start it again; it continues", example={"work": "features 3", "detail": "KilledWorker: 3"})
def work_not_finished(work: str, detail: str) -> str:
    return f"{work}: no worker could finish it: {detail}"


@message(
    advice="install the same there",
    joint=": ",
    example={
        "worker": "tcp://host:1",
        "versions": "colmap-inertial 1.0, pycolmap 3.12",
        "wanted": "colmap-inertial 1.1, pycolmap 3.12",
    },
)
def worker_of_another_version(worker: str, versions: str, wanted: str) -> str:
    return f"worker {worker} has {versions}; here is {wanted}"


@message(
    advice="put the output on a path that all machines share",
    joint=": ",
    example={"worker": "tcp://host:1", "folder": "out"},
)
def worker_sees_no_output(worker: str, folder: str) -> str:
    return f"worker {worker} cannot access {folder}"


@message(example={"work": "features 3"})
def work_not_wanted(work: str) -> str:
    return f"{work}: cancelled"


state("work-needs-dask", "--scheduler uses a Dask cluster")
state("captures-need-dask", "--scheduler runs captures on a Dask cluster")


@message(example={"work": "features 3", "signal": 9, "on_worker": False})
def process_killed(work: str, signal: int, on_worker: bool) -> str:
    if_short = "give workers more of it, or one thread each (--nthreads 1)" if on_worker else "use fewer --workers"
    return f"{work}: the process was killed (signal {signal}); if memory ran out, {if_short}"


@message(example={"work": "features 3", "exit_code": 1, "detail": None})
def process_failed(work: str, exit_code: int, detail: str | None) -> str:
    return f"{work} failed: {f'exit code {exit_code}' if detail is None else detail}"
