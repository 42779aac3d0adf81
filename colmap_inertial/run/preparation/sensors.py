"""What a capture holds beside the IMU that knows of metres, found and joined with its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.errors import FormatError, InertialError, fact_of
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReferenceOptions, ScaleFrom
from colmap_inertial.core.types import CameraTrajectory, FrameTiming
from colmap_inertial.core.types.depth import PinholeGrid
from colmap_inertial.core.types.evidence import AbsentSensor, Sensor
from colmap_inertial.evidence.device_path import join_by_time
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.capture_depth import DevicePoses
from colmap_inertial.io.device_folders import DeviceFolder, is_device_folder, read_device_folder
from colmap_inertial.io.fingerprints import fingerprint
from colmap_inertial.io.trajectories import read_tum
from colmap_inertial.run.preparation.geolocation import positions_of
from colmap_inertial.run.stages.capture_sensors import CaptureSensors, KnownDistance, SeenTarget

#: A pose is of an image where it was taken within this share of the time between poses.
_WITHIN = 0.5


def find_sensors(
    capture: Capture,
    names: Sequence[str],
    size_px: Callable[[], tuple[int, int]],
    *,
    timing: FrameTiming | None,
    chosen: Sequence[ScaleFrom] = (),
    images: Path | None = None,
    made: Path | None = None,
    reference: ReferenceOptions = ReferenceOptions(),
) -> CaptureSensors:
    """Depth maps, the device's own path and positions of a capture, by the names of its images, and known lengths.

    Parameters
    ----------
    capture
        The capture.
    names
        Of the images.
    size_px
        Gives width and height of the images; asked where maps do not say of which they are.
    timing
        When they were exposed, on the clock of the device's path; ``None`` where nobody knows.
    chosen
        The sensors that were asked for by name; all where empty.
    images
        Where an existing project has its images.
    made
        Where the images that agree with the model will be, where they are not those.
    reference
        A known distance; what a target is, the capture says.

    Raises
    ------
    FormatError, InertialError
        For what cannot be read, and for a sensor that was asked for by name and is not there.
    """
    found = CaptureSensors()
    if capture.poses is not None and _wanted(chosen, "device", "depth"):
        folder = _read_poses(capture.poses)
        own = _name_by_images(folder, names, timing)
        if _wanted(chosen, "device") and folder.is_metric:
            device, up = _rename_path(folder.trajectory, own), folder.up_in_world
            found = replace(found, device=device, up_in_device=None if up is None else np.array(up))
        if _wanted(chosen, "depth") and folder.depth is not None:
            found = replace(found, depth=folder.depth.renamed(own))
    if capture.depth is not None and _wanted(chosen, "depth"):
        found = replace(found, depth=capture.depth.maps(tuple(names), _grid_of(*size_px())))
    if _wanted(chosen, "positions"):
        try:
            found = replace(found, fixes=positions_of(capture, names, images))
        except FormatError as error:
            if "positions" in chosen:
                raise
            if error.code not in _NO_POSITIONS:
                absent = AbsentSensor(sensor="positions", reasons=(fact_of(error),))
                found = replace(found, absent=(*found.absent, absent))
    of_model = images if made is None else made
    seen = None
    if capture.target is not None and of_model is not None:
        seen = SeenTarget(spec=capture.target, images=of_model)
    if "target" in chosen:
        found = replace(found, target=seen)
    if "distance" in chosen:
        markers = seen if reference.has_markers else None
        found = replace(found, distance=KnownDistance(lengths=reference, markers=markers))
    there = {"depth": found.depth, "device": found.device, "target": found.target}
    for sensor, value in there.items():
        if sensor in chosen and value is None:
            raise InertialError(Fact("sensor-not-there", sensor=sensor, capture=str(capture.path)))
    behind = () if found.depth is None else tuple(path for paths in found.depth.files.values() for path in paths)
    return replace(found, files=tuple(fingerprint(Path(path)) for path in behind))


#: Where a capture simply has no positions.
_NO_POSITIONS = frozenset(
    {"no-positions-in-telemetry", "no-positions-in-exif", "nothing-with-positions", "frames-on-another-clock"}
)


def _wanted(chosen: Sequence[ScaleFrom], *sensors: Sensor) -> bool:
    return not chosen or any(sensor in chosen for sensor in sensors)


def _read_poses(given: DevicePoses) -> DeviceFolder:
    if is_device_folder(given.path):
        return read_device_folder(given.path)
    trajectory = replace(read_tum(given.path), length_unit="m")
    return DeviceFolder(app="TUM", trajectory=trajectory, on_clock_of_images=True, up_in_world=given.up_in_world)


def _name_by_images(folder: DeviceFolder, names: Sequence[str], timing: FrameTiming | None) -> dict[str, str]:
    """The device's name of each image: by the time, where the device's clock is that of the images, else by the name.

    Names of images that were taken from a video are other ones than the device's, or belong to others by chance.
    """
    path = folder.trajectory
    if timing is None or not folder.on_clock_of_images:
        stems = {Path(name).stem: name for name in path.names}
        return {name: stems[stem] for name in names if (stem := Path(name).stem) in stems}
    place = {name: i for i, name in enumerate(timing.names)}
    timed = tuple(name for name in names if name in place)
    t_ns = timing.epoch_ns + np.rint(1e9 * timing.t_s[[place[name] for name in timed]]).astype(np.int64)
    within_s = _WITHIN * float(np.median(np.diff(path.t_s)))
    return join_by_time(path, timed, t_ns, within_s=within_s)


def _rename_path(path: CameraTrajectory, own: Mapping[str, str]) -> CameraTrajectory:
    place = {name: i for i, name in enumerate(path.names)}
    images = sorted(own, key=lambda name: place[own[name]])
    at = np.array([place[own[name]] for name in images], dtype=np.intp)
    return CameraTrajectory(
        names=tuple(images),
        t_s=path.t_s[at],
        cam_from_world_xyzw=path.cam_from_world_xyzw[at],
        cam_in_world=path.cam_in_world[at],
        epoch_ns=path.epoch_ns,
        length_unit=path.length_unit,
    )


def _grid_of(width: int, height: int) -> PinholeGrid:
    """A view of some size; what is compared at keypoints needs no more of it."""
    side = float(max(width, height))
    return PinholeGrid(width=width, height=height, focal_px=(side, side), centre_px=(width / 2, height / 2))
