"""Recipes: a scene, its camera, its IMU and its motion in one small TOML file, from which a capture is made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from colmap_inertial.core.facts import Fact
from colmap_inertial.core.types import CameraModel, ReadoutDirection
from colmap_inertial.io.files import reader
from colmap_inertial.io.toml_section import Section, read_toml
from colmap_inertial.tools.simulate.device import DeviceOptions
from colmap_inertial.tools.simulate.motion import MotionKind, MotionOptions
from colmap_inertial.tools.simulate.render import ShutterCamera
from colmap_inertial.tools.simulate.sensors import IMU_PRESETS, ImuOptions
from colmap_inertial.tools.simulate.world import Board, WorldKind

T = TypeVar("T")
FrameFormat = Literal["jpeg", "png", "h264", "stray-scanner"]
#: Those that hold a video.
VIDEO_FORMATS: tuple[FrameFormat, ...] = ("h264", "stray-scanner")

#: Fields that take one of a few texts.
_CHOICES: dict[str, tuple[str, ...]] = {
    "world": get_args(WorldKind),
    "format": get_args(FrameFormat),
    "kind": get_args(MotionKind),
    "readout_direction": get_args(ReadoutDirection),
}


@dataclass(frozen=True, kw_only=True)
class SceneRecipe:
    """Everything that a simulated capture is made from.

    As TOML: the plain fields at the top, then the tables ``[board]``, ``[motion]``, ``[imu]`` (with ``preset``, one of
    ``IMU_PRESETS``, as the start), ``[device]``, ``[camera]`` (with ``model``, ``width``, ``height``, ``params`` of a
    COLMAP camera) and, for more cameras on the same body, ``[rig.NAME]`` (what they leave out is as in ``[camera]``).
    """

    seed: int = 1
    """Same recipe, same capture, to the last bit on one machine."""
    world: WorldKind = "desk"
    """The scene that is filmed."""
    frame_rate_hz: float = 3.0
    """Frames per second."""
    format: FrameFormat = "jpeg"
    """jpeg, png: a folder of images; h264: a video; stray-scanner: the folder that this app writes, with a video, the
    path that the device computes and its depth maps, and no description."""
    quality: int = 90
    """Quality of JPEG, 0 to 100."""
    crf: int = 18
    """Constant rate factor of H.264, 0 (lossless) to 51."""
    depth_maps: bool = False
    """Also write the true depth map of every frame, at its middle instant, as NumPy files."""
    camera_known: bool = True
    """Whether capture.toml gives the intrinsics, or leaves them to COLMAP."""
    board: Board = field(default_factory=Board)
    """The checkerboard."""
    motion: MotionOptions = field(default_factory=MotionOptions)
    """How the body moves."""
    imu: ImuOptions = field(default_factory=ImuOptions)
    """Gyroscope and accelerometer."""
    device: DeviceOptions = field(default_factory=DeviceOptions)
    """The path and the depth maps that a phone computes, for Stray Scanner."""
    camera: ShutterCamera = field(
        default_factory=lambda: ShutterCamera(
            model=CameraModel(
                model="OPENCV", width=640, height=480, params=(520.0, 520.0, 320.0, 240.0, 0.08, -0.12, 0.0005, -0.0003)
            )
        )
    )
    """The camera that the capture is about."""
    rig: Mapping[str, ShutterCamera] = field(default_factory=dict)
    """More cameras on the body, by name."""

    def __post_init__(self) -> None:
        if not self.frame_rate_hz > 0:
            raise ValueError("frame_rate_hz must be positive")
        if not (0 <= self.quality <= 100 and 0 <= self.crf <= 51):
            raise ValueError("quality goes from 0 to 100, crf from 0 to 51")
        is_pinhole = self.camera.model.model in ("PINHOLE", "SIMPLE_PINHOLE")
        if self.format == "stray-scanner" and (self.rig or self.depth_maps or not is_pinhole):
            raise ValueError(
                "stray-scanner takes one camera without distortion (PINHOLE), and no depth_maps beside its own"
            )


@reader("a recipe")
def load_recipe(path: Path) -> SceneRecipe:
    """Read a recipe.

    Raises
    ------
    FormatError
        For what is not TOML, an unknown key (the nearest known one is named) or a value that cannot be.
    """
    root = read_toml(path)
    default = SceneRecipe()
    imu_table = root.table("imu")
    preset = imu_table.choice("preset", IMU_PRESETS) or "phone"
    imu = _read(imu_table, IMU_PRESETS[preset])
    camera = _read_camera(root.table("camera"), default.camera)
    rig_table = root.table("rig")
    names = [] if root.raw("rig") is None else list(root.raw("rig"))
    rig = {name: _read_camera(rig_table.table(name), camera) for name in names}
    rig_table.finish()
    parts = {
        "board": _read(root.table("board"), default.board),
        "motion": _read(root.table("motion"), default.motion),
        "imu": imu,
        "device": _read(root.table("device"), default.device),
        "camera": camera,
        "rig": rig,
    }
    return _read(root, default, parts)


def _read(table: Section, default: T, known: Mapping[str, Any] | None = None) -> T:
    """A copy of ``default`` (a dataclass) with what the table says."""
    assert is_dataclass(default) and not isinstance(default, type)
    values: dict[str, Any] = dict(known or {})
    for f in fields(default):
        if f.name not in values:
            value = _value(table, f.name, getattr(default, f.name))
            if value is not None:
                values[f.name] = value
    table.finish()
    try:
        return replace(default, **values)
    except ValueError as error:
        table.fail(None, Fact("invalid-values", detail=str(error)))


def _value(table: Section, key: str, default: object) -> object:
    if key in _CHOICES:
        return table.choice(key, _CHOICES[key])
    if isinstance(default, bool):
        return table.boolean(key)
    if isinstance(default, int):
        value = table.number(key)
        if value is not None and value != int(value):
            table.fail(key, Fact("not-a-whole-number", found=value))
        return None if value is None else int(value)
    if isinstance(default, tuple):
        return table.numbers(key, len(default))
    return table.number(key)


def _read_camera(table: Section, default: ShutterCamera) -> ShutterCamera:
    model = default.model
    model = CameraModel(
        model=table.text("model") or model.model,
        width=table.integer("width") or model.width,
        height=table.integer("height") or model.height,
        params=table.numbers("params") or model.params,
    )
    return _read(table, default, {"model": model})


def recipe_text(recipe: SceneRecipe) -> str:
    """The recipe as TOML, every value spelled out; :func:`load_recipe` reads it back."""
    tables: dict[str, Board | MotionOptions | ImuOptions | DeviceOptions | ShutterCamera] = {
        "board": recipe.board,
        "motion": recipe.motion,
        "imu": recipe.imu,
        **({"device": recipe.device} if recipe.format == "stray-scanner" else {}),
        "camera": recipe.camera,
        **{f"rig.{name}": camera for name, camera in recipe.rig.items()},
    }
    lines = _lines(
        {f.name: getattr(recipe, f.name) for f in fields(recipe) if f.name not in {*tables, "device", "rig"}}
    )
    for name, table in tables.items():
        values = {f.name: getattr(table, f.name) for f in fields(table)}
        if isinstance(table, ShutterCamera):
            values = {**{f.name: getattr(table.model, f.name) for f in fields(table.model)}, **values}
            values["model"] = table.model.model
        lines += ["", f"[{name}]", *_lines(values)]
    return "\n".join(lines) + "\n"


def _lines(values: Mapping[str, object]) -> list[str]:
    def toml(value: object) -> str:
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, str):
            return f'"{value}"'
        if isinstance(value, tuple):
            return "[" + ", ".join(toml(float(v)) for v in value) + "]"
        return repr(value)

    return [f"{key} = {toml(value)}" for key, value in values.items() if value is not None]
