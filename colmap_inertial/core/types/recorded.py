"""Recorded and reconstructed data: frames with times, cameras, apertures, trajectories, satellite positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal, Protocol

import numpy as np

from colmap_inertial.core.arrays import (
    Array,
    BoolArray,
    IndexArray,
    Int64Array,
    UInt8Array,
    UInt16Array,
    check_fields,
    set_fields,
)
from colmap_inertial.core.facts import Fact, as_fact
from colmap_inertial.core.geometry import quat_conjugate, quat_log, quat_multiply
from colmap_inertial.core.summary import prints_in_lines

LengthUnit = Literal["model", "m"]
ReadoutDirection = Literal["down", "up", "right", "left"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraModel:
    """Intrinsics in COLMAP's terms: model name, image size, parameters; the top-left pixel's centre is (0.5, 0.5)."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"image size {self.width}x{self.height} must be positive")
        params = tuple(float(p) for p in self.params)
        if not np.isfinite(params).all():
            raise ValueError("camera parameters must be finite")
        set_fields(self, params=params)


class Projector(Protocol):
    """Maps between pixels and normalised image coordinates; ``pycolmap.Camera`` is one."""

    def cam_from_img(self, image_points: Array, /) -> Array: ...

    def img_from_cam(self, cam_points: Array, /) -> Array: ...


class Action(StrEnum):
    """What became of a frame, its keypoints or a model."""

    #: Nothing was changed.
    NOTHING = ""
    #: The original file or pixels.
    PASSED = "passed"
    #: Not shown to COLMAP.
    DROPPED = "dropped"
    #: Changed by a stage that has no other word here.
    CHANGED = "changed"
    DEBLURRED = "deblurred"
    FUSED = "fused"
    RECTIFIED = "rectified"
    ADJUSTED = "adjusted"
    LEFT_OUT = "left out"
    REGISTERED_AGAIN = "registered again"
    JOINED = "joined"
    REFINED = "refined"


@dataclass(frozen=True, kw_only=True)
class Treatment:
    """Decision of a stage about a frame, its keypoints or a model, with the reason.

    Attributes
    ----------
    stage
        Which stage, in a word.
    reason
        Why; words of a user's own stage become a fact with the code ``"stated"``.
    action
        What became of it.
    values
        Figures, in JSON types.

    Raises
    ------
    ValueError
        For an action that is none of :class:`Action`.
    """

    stage: str
    reason: Fact
    action: Action = Action.NOTHING
    values: Mapping[str, object] = field(default_factory=dict)

    def __init__(
        self,
        *,
        stage: str,
        reason: Fact | str,
        action: Action | str = Action.NOTHING,
        values: Mapping[str, object] | None = None,
    ) -> None:
        set_fields(self, stage=stage, reason=as_fact(reason), action=Action(action), values=values or {})


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """One decoded frame on its way to feature extraction.

    Attributes
    ----------
    name
        File name that COLMAP will see; the frame's identity from here on.
    image
        (H, W) or (H, W, 3) pixels, RGB order, uint8 or uint16, read-only. A stage returns a new frame
        (``dataclasses.replace``) with a new array; one that leaves the array alone has the original file passed on.
    t_s
        Start of exposure of row 0, camera clock, seconds since the timing's ``epoch_ns``.
    exposure_s
        ``None`` where unknown.
    readout_s
        From the first row to one past the last; 0 is a global shutter; ``None`` where unknown.
    camera
        ``None`` lets COLMAP calibrate.
    smoothing_px
        Standard deviation of the Gaussian by which COLMAP sees the image smoothed, in linear light; everybody else has
        the image as it is. 0 does nothing.
    dropped
        Whether COLMAP shall not see it. A stage that yields a dropped frame can say why; one that is simply not
        yielded is dropped without a reason.
    treatments
        What the stages before did, in order.
    """

    name: str
    image: UInt8Array | UInt16Array
    t_s: float
    exposure_s: float | None = None
    readout_s: float | None = None
    camera: CameraModel | None = None
    smoothing_px: float = 0.0
    dropped: bool = False
    treatments: tuple[Treatment, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.smoothing_px < 100:
            raise ValueError(f"{self.name}: smoothing_px must be from 0 to below 100, not {self.smoothing_px:g}")
        if self.image.ndim not in (2, 3) or self.image.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"{self.name}: an image is (H, W) or (H, W, 3), uint8 or uint16")
        view = self.image.view()
        view.setflags(write=False)
        set_fields(self, image=view)


@dataclass(frozen=True, eq=False, kw_only=True)
class Keypoints:
    """Keypoints of one image, on their way to matching.

    Attributes
    ----------
    name
        The image's.
    xy_px
        (N, 2) COLMAP's pixel coordinates. A stage may move them, and keeps their number and order.
    rectified
        Whether they are where a global shutter would have seen them.
    treatments
        What the stages before did, in order.
    """

    name: str
    xy_px: Array
    rectified: bool = False
    treatments: tuple[Treatment, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, xy_px=("N", 2))


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class FrameTiming:
    """Exposure times of frames, on the camera's clock.

    Attributes
    ----------
    names
        (F,) file names, in order of time.
    t_s
        (F,) start of exposure of row 0, seconds since ``epoch_ns``, strictly increasing.
    exposure_s
        (F,) exposure times, or ``None`` where unknown.
    readout_s
        From the first row to one past the last; 0 is a global shutter; ``None`` where unknown.
    readout_direction
        Where the rows' exposure moves in the stored image.
    """

    names: tuple[str, ...]
    t_s: Array
    exposure_s: Array | None = None
    readout_s: float | None = None
    readout_direction: ReadoutDirection = "down"
    epoch_ns: int = 0

    def __post_init__(self) -> None:
        check_fields(self, t_s=("F",), exposure_s=("F",))
        if not len(self.names) == len(set(self.names)) == len(self.t_s):
            raise ValueError("frame names must be unique, one for each time")
        set_fields(self, names=tuple(self.names))
        if self.readout_s is not None and not 0 <= self.readout_s < 1:
            raise ValueError("readout_s must be from 0 to 1 second")

    def pose_t_s(self) -> Array:
        """(F,) the instants that whole-image poses hold: mid-exposure of the middle row."""
        exposure = 0.0 if self.exposure_s is None else self.exposure_s
        return np.asarray(self.t_s + 0.5 * exposure + 0.5 * (self.readout_s or 0.0))

    def select(self, index: IndexArray) -> FrameTiming:
        """Some of the frames, by places in order of time."""
        exposure_s = None if self.exposure_s is None else self.exposure_s[index]
        names = tuple(self.names[i] for i in index.tolist())
        return replace(self, names=names, t_s=self.t_s[index], exposure_s=exposure_s)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameLog:
    """A recorder's notes on the frames of its video, beside the inertial samples.

    Attributes
    ----------
    t_s
        (F,) start of exposure of row 0 (or the recorder's own stamp) of each frame of the video, in seconds since
        ``epoch_ns``; empty where the recorder noted no times.
    epoch_ns
        The clock's reading, in nanoseconds, where ``t_s`` is zero.
    in_video_time
        Whether ``t_s`` are the video's presentation stamps, which the IMU's stamps were brought to; otherwise they are
        the recorder's own times of the frames.
    shared_clock
        Whether ``t_s`` and the IMU's stamps come from one clock.
    exposure_s, iso, focal_px
        (F,) of each frame, or ``None`` where unknown.
    readout_s, readout_direction
        As in :class:`FrameTiming`.
    stabilised
        Whether the image was stabilised (electronically, or by moving the lens), so that it does not turn with the
        IMU; ``None`` where the recorder did not say.
    stabilisation
        In the recorder's words.
    camera
        Intrinsics of the video's images.
    up_in_imu
        (F, 3) unit vectors away from the ground, IMU frame, as the recorder's own filter saw them.
    start_from_imu_xyzw
        (F, 4) orientations of the device against the first frame's, by the recorder's own filter.
    """

    t_s: Array
    epoch_ns: int = 0
    in_video_time: bool = False
    shared_clock: bool = False
    exposure_s: Array | None = None
    iso: Array | None = None
    focal_px: Array | None = None
    readout_s: float | None = None
    readout_direction: ReadoutDirection = "down"
    stabilised: bool | None = None
    stabilisation: str = ""
    camera: CameraModel | None = None
    up_in_imu: Array | None = None
    start_from_imu_xyzw: Array | None = None

    def __post_init__(self) -> None:
        of_frames = dict.fromkeys(("t_s", "exposure_s", "iso", "focal_px"), ("F",))
        check_fields(self, **of_frames, start_from_imu_xyzw=("F", 4), up_in_imu=("F", 3))
        if self.readout_s is not None and not 0 <= self.readout_s < 1:
            raise ValueError("readout_s must be from 0 to 1 second")


@prints_in_lines
@dataclass(frozen=True, eq=False, kw_only=True)
class CameraTrajectory:
    """Camera poses of a reconstruction with their times.

    Attributes
    ----------
    names
        (F,) image names (or the index as text, where there are no images).
    t_s
        (F,) the instant each pose holds, camera clock, seconds since ``epoch_ns``, strictly increasing.
    cam_from_world_xyzw
        (F, 4) rotations.
    cam_in_world
        (F, 3) camera centres, in ``length_unit``.
    pose_cov
        (F, 6, 6) optional covariance: rotation error (rad, camera frame, left), camera centre (``length_unit``, world).
    """

    names: tuple[str, ...]
    t_s: Array
    cam_from_world_xyzw: Array
    cam_in_world: Array
    length_unit: LengthUnit = "model"
    epoch_ns: int = 0
    pose_cov: Array | None = None

    def __post_init__(self) -> None:
        check_fields(self, t_s=("F",), cam_from_world_xyzw=("F", 4), cam_in_world=("F", 3), pose_cov=("F", 6, 6))
        if len(self.names) != len(self.t_s):
            raise ValueError("one name for each pose")
        set_fields(self, names=tuple(self.names))

    def __len__(self) -> int:
        return len(self.t_s)

    def turn_rad(self) -> Array:
        """(F-1, 3) rotation vectors ``before_from_after`` of consecutive frames, camera frame."""
        pose = self.cam_from_world_xyzw
        return quat_log(quat_multiply(pose[:-1], quat_conjugate(pose[1:])))

    def select(self, keep: BoolArray | IndexArray | slice) -> CameraTrajectory:
        """The poses that ``keep`` (mask, increasing indices or slice) picks."""
        index = np.arange(len(self))[keep]
        return replace(
            self,
            names=tuple(self.names[i] for i in index),
            t_s=self.t_s[index],
            cam_from_world_xyzw=self.cam_from_world_xyzw[index],
            cam_in_world=self.cam_in_world[index],
            pose_cov=None if self.pose_cov is None else self.pose_cov[index],
        )


#: What an aperture's filter passes; ``other`` (near infrared, say) takes part in matching and in no colour.
SpectralRole = Literal["red", "green", "blue", "luminance", "other"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Aperture:
    """One camera unit of a multi-aperture camera.

    Attributes
    ----------
    name
        Unique in its rig.
    role
        What its filter passes.
    camera
        Intrinsics.
    cam_from_rig_xyzw
        (4,) rotation.
    cam_in_rig
        (3,) camera centre, in the rig's ``length_unit``.
    """

    name: str
    role: SpectralRole
    camera: CameraModel
    cam_from_rig_xyzw: Array
    cam_in_rig: Array

    def __post_init__(self) -> None:
        check_fields(self, cam_from_rig_xyzw=(4,), cam_in_rig=(3,))


@dataclass(frozen=True, eq=False, kw_only=True)
class ApertureRig:
    """The camera units of a multi-aperture camera.

    Attributes
    ----------
    apertures
        Two or more, at different places. The first one is the reference, through which the fused image is seen; the
        second one is its partner, and disparities are shifts between these two.
    length_unit
        ``"m"``, or ``"model"`` where the calibration has no scale.
    """

    apertures: tuple[Aperture, ...]
    length_unit: LengthUnit = "m"

    def __post_init__(self) -> None:
        set_fields(self, apertures=tuple(self.apertures))
        if len(self.apertures) < 2:
            raise ValueError("a rig needs at least two apertures")
        if len(set(self.names)) != len(self.apertures):
            raise ValueError("apertures must have different names")
        centres = np.stack([aperture.cam_in_rig for aperture in self.apertures])
        if not np.linalg.norm(centres[1] - centres[0]) > 0:
            raise ValueError(f"{self.names[0]} and {self.names[1]} are at the same place: no parallax, no disparity")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the apertures, in order."""
        return tuple(aperture.name for aperture in self.apertures)

    @property
    def reference(self) -> Aperture:
        """The aperture through which the fused image is seen."""
        return self.apertures[0]


#: What heights count from: WGS84's ellipsoid, the sea, or what nobody said.
HeightDatum = Literal["ellipsoid", "sea", "unknown"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionFixes:
    """Positions of a satellite receiver, WGS84.

    Attributes
    ----------
    latitude_deg, longitude_deg
        (N,) north and east positive.
    height_m
        (N,) nan where it is not known.
    sigma_m
        (N,) standard deviation of each horizontal coordinate as the receiver states it; nan where it does not.
    t_ns
        (N,) when, on the clock of the video that holds them; ``None`` where ``names`` says it.
    names
        (N,) of the images that hold them; ``None`` where ``t_ns`` says it.
    height_above
        What heights count from.
    source
        Where they were read, in words.
    """

    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    sigma_m: Array
    t_ns: Int64Array | None = None
    names: tuple[str, ...] | None = None
    height_above: HeightDatum = "unknown"
    source: str = ""

    def __post_init__(self) -> None:
        check_fields(self, latitude_deg=("N",), longitude_deg=("N",))
        n = len(self.latitude_deg)
        if (self.t_ns is None) == (self.names is None):
            raise ValueError("either times or names")
        if self.names is not None and len(self.names) != n:
            raise ValueError("one name for each position")
        if np.abs(self.latitude_deg).max(initial=0) > 90 or np.abs(self.longitude_deg).max(initial=0) > 360:
            raise ValueError("latitudes reach from -90 to 90 degrees, longitudes from -180 to 180")
        for name in ("height_m", "sigma_m"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (n,) or np.isinf(values).any():
                raise ValueError(f"{name}: must be ({n},), finite or nan")
            values.setflags(write=False)
            set_fields(self, **{name: values})
        if self.t_ns is not None:
            set_fields(self, t_ns=np.asarray(self.t_ns, dtype=np.int64))

    def select(self, index: IndexArray | BoolArray) -> PositionFixes:
        """Some of them."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[index])
        arrays = ("latitude_deg", "longitude_deg", "height_m", "sigma_m")
        t_ns = None if self.t_ns is None else self.t_ns[index]
        return replace(self, **{name: getattr(self, name)[index] for name in arrays}, t_ns=t_ns, names=names)
