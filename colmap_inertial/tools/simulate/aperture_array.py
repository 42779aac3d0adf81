"""Captures of a multi-aperture camera: four views of each exposure, each with its own colour filter."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from colmap_inertial.core.arrays import UInt8Array, UInt16Array
from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import SpectralRole
from colmap_inertial.imaging.transfer import decode_table, srgb_from_linear
from colmap_inertial.io.files import write_text
from colmap_inertial.io.images import read_image
from colmap_inertial.run.stages.frame_folder import encode_image
from colmap_inertial.tools.simulate.capture import write_capture
from colmap_inertial.tools.simulate.recipe import SceneRecipe
from colmap_inertial.tools.simulate.render import ShutterCamera

#: Weights of linear RGB in luminance (ITU-R BT.709).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class ApertureArray:
    """Apertures on the main camera's sensor plane that differ in place and filter; the first one is the main camera."""

    baseline_m: float = 0.01
    """Side of the square."""
    layout: Mapping[SpectralRole, tuple[float, float]] = field(
        default_factory=lambda: {
            "green": (0.0, 0.0),
            "red": (1.0, 0.0),
            "blue": (0.0, 1.0),
            "luminance": (1.0, 1.0),
        }
    )
    """Place of each, right and down, in baselines."""


def write_aperture_capture(
    recipe: SceneRecipe,
    folder: Path,
    array: ApertureArray | None = None,
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Make the capture that a recipe describes, as a multi-aperture camera records it.

    As :func:`write_capture`, but ``frames/`` and ``frames_ROLE/`` hold one grey image of each aperture;
    ``rig_config.json`` is COLMAP's description of the array, and ``frames_rgb/`` what a camera with all colours in the
    reference's place would have seen.

    Returns
    -------
    The path of ``capture.toml``.
    """
    array = array or ApertureArray()
    if recipe.format != "png":
        raise ValueError("sub-images are written as png: another format would encode them twice")
    roles = list(array.layout)
    places = {role: (x * array.baseline_m, y * array.baseline_m, 0.0) for role, (x, y) in array.layout.items()}
    rig: dict[str, ShutterCamera] = {
        role: replace(recipe.camera, cam_in_body_m=_shift_camera(recipe.camera, places[role])) for role in roles[1:]
    }
    toml = write_capture(replace(recipe, rig=rig), folder, workers=workers, progress=progress)
    (folder / "frames").rename(folder / "frames_rgb")
    for i, role in enumerate(roles):
        source = folder / ("frames_rgb" if i == 0 else f"frames_{role}")
        target = folder / ("frames" if i == 0 else f"frames_{role}")
        target.mkdir(exist_ok=True)
        for path in sorted(source.glob("*.png")):
            encode_image(target / path.name, _apply_filter(read_image(path), role))
    write_text(folder / "rig_config.json", json.dumps([{"cameras": _rig_cameras(recipe, places)}], indent=1) + "\n")
    lines = ["[apertures]", 'calibration = "rig_config.json"', 'unit = "m"']
    for i, role in enumerate(roles):
        lines += ["", f"[apertures.{role}]", f'role = "{role}"']
        lines += [] if i == 0 else [f'folder = "frames_{role}"']
    described = toml.read_text(encoding="utf-8").partition("\n[rig.")[0]
    # in place of the [camera] table, where there is one: the calibration has it
    place = re.compile(r"(\[camera\]\n.*?\n)?(?=\[imu\.)", re.DOTALL)
    write_text(toml, place.sub(lambda _: "\n".join(lines) + "\n\n", described, count=1))
    return toml


def _shift_camera(camera: ShutterCamera, by_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """Position on the body of a camera moved along its own axes."""
    x, y, z = np.array(camera.cam_in_body_m) + matrix_from_quat(np.array(camera.body_from_cam_xyzw)) @ np.array(by_m)
    return float(x), float(y), float(z)


def _apply_filter(image: UInt8Array | UInt16Array, role: SpectralRole) -> UInt8Array:
    """The plane of a colour image behind an aperture's filter."""
    if role in ("red", "green", "blue"):
        return np.asarray(image[..., ("red", "green", "blue").index(role)], dtype=np.uint8)
    light = np.asarray(decode_table(image.dtype)[image] @ _LUMINANCE, dtype=np.float64)
    return np.asarray(np.rint(255 * srgb_from_linear(light)), dtype=np.uint8)


def _rig_cameras(
    recipe: SceneRecipe, places: Mapping[SpectralRole, tuple[float, float, float]]
) -> list[dict[str, object]]:
    model = recipe.camera.model
    cameras: list[dict[str, object]] = []
    for i, (role, place) in enumerate(places.items()):
        entry: dict[str, object] = {"image_prefix": f"{role}/"}
        if i == 0:
            entry["ref_sensor"] = True
        else:
            entry["cam_from_rig_rotation"] = [1.0, 0.0, 0.0, 0.0]
            entry["cam_from_rig_translation"] = [-c for c in place]
        entry["camera_model_name"] = model.model
        entry["camera_params"] = list(model.params)
        cameras.append(entry)
    return cameras
