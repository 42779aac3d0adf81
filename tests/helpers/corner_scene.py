"""A textured corner of a room, filmed by a hand: exact blur and rolling shutter with parallax, in seconds."""

import copy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.geometry import matrix_from_quat
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.tools.simulate import Motion, MotionOptions, make_motion
from colmap_inertial.tools.simulate.render import colmap_camera
from colmap_inertial.tools.simulate.textures import poster
from tests.helpers.far_scene import CAM_FROM_IMU, rays_of, srgb

LENS = CameraModel(model="PINHOLE", width=400, height=300, params=(340, 340, 200, 150))
#: Planes as the axis that they stand on and where; the IMU's clock against the camera's.
PLANES = ((2, -0.4), (1, 1.4), (0, -1.6), (0, 1.6))
#: Side of a plane's texture, at 400 px a metre: no place is seen twice. Copies of a place match each other, the better
#: the pictures are, and fold the model.
SIDE = 1536
IMU_CLOCK_S = 11.0


@lru_cache(maxsize=2)
def _posters(seed, side):
    """What hangs on the planes, which takes seconds to print, and the generator as it is then."""
    rng = np.random.default_rng(seed)
    textures = [poster(rng, side, side) for _ in PLANES]
    # one above the other, each with its last row again: what is between two rows of one is not of two textures
    atlas = np.concatenate([np.concatenate([texture, texture[-1:]]) for texture in textures])
    return textures, atlas, rng


@dataclass(frozen=True, eq=False, kw_only=True)
class CornerScene:
    """The corner, the hand's motion and the shutter."""

    motion: Motion
    textures: list[np.ndarray]
    atlas: np.ndarray
    frames: int
    exposure_s: float
    readout_s: float

    @classmethod
    def make(cls, *, exposure_s, readout_s, frames=24, seed=5, vigour=1.0, side=SIDE):
        textures, atlas, rng = _posters(seed, side)
        options = MotionOptions(
            kind="orbit", duration_s=frames / 3, heading_deg=-90.0, vigour=vigour, radius_m=1.6, arc_deg=40,
            sweep_s=frames / 3,
        )  # fmt: skip
        return cls(
            motion=make_motion(options, copy.deepcopy(rng)), textures=textures, atlas=atlas, frames=frames,
            exposure_s=exposure_s, readout_s=readout_s,
        )  # fmt: skip

    def shutter(self, i):
        return FrameShutter(
            width=LENS.width, height=LENS.height, t_s=0.1 + i / 3.2, exposure_s=self.exposure_s,
            readout_s=self.readout_s,
        )  # fmt: skip

    def picture(self, i, *, noise=0.006, sharp=False):
        """(H, W, 3) 8 bit sRGB; sharp, each line as it is in the middle of its exposure."""
        shutter = self.shutter(i)
        pixels, rays = rays_of(LENS)
        rays = rays.astype(np.float32)
        samples = 1 if sharp else max(2, round(self.exposure_s * 400))
        light = np.zeros(rays.shape, np.float32)
        for k in range(samples):
            t_s = shutter.middle_s(pixels[:, 0]) + self.exposure_s * ((k + 0.5) / samples - 0.5)
            rotation = matrix_from_quat(self.motion.world_from_cam_xyzw(t_s)).astype(np.float32)
            light += self._seen(self.motion.cam_in_world_m(t_s), rays @ np.swapaxes(rotation, 1, 2)) / samples
        light += noise * np.random.default_rng(i).standard_normal(light.shape)
        return np.round(255 * srgb(light)).astype(np.uint8)

    def _seen(self, centre, direction):
        """Light along (H, W, 3) directions, from a place for each row; in single precision, which is quicker."""
        centre = centre.astype(np.float32)
        nearest, plane = np.full(direction.shape[:2], np.inf, np.float32), np.zeros(direction.shape[:2], np.int8)
        for k, (of, place) in enumerate(PLANES):
            with np.errstate(divide="ignore"):
                along = (np.float32(place) - centre[:, None, of]) / direction[..., of]
            nearer = (along > 0) & (along < nearest)
            np.copyto(nearest, along, where=nearer)
            np.copyto(plane, np.int8(k), where=nearer)
        hit = np.isfinite(nearest)
        np.copyto(nearest, np.float32(0), where=~hit)
        x, y, z = (400 * (centre[:, None, k] + nearest * direction[..., k]) for k in range(3))
        axis = np.array([of for of, _ in PLANES])
        u, v = np.where((axis == 0)[plane], y, x), np.where((axis == 2)[plane], y, z)
        side = len(self.textures[0])
        u, v = (at - side * np.floor(at / side) for at in (u, v))
        v += (side + 1) * plane.astype(np.float32)
        out = cv2.remap(self.atlas, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out *= hit[..., None]
        return out

    def true_blur(self, i, xy):
        """(N, 2) px that the content at (N, 2) points of a global-shutter picture moves by while it is exposed."""
        shutter = self.shutter(i)
        t_s = shutter.reference_s() + np.array([-0.5, 0.0, 0.5]) * self.exposure_s
        rotation, centre = matrix_from_quat(self.motion.world_from_cam_xyzw(t_s)), self.motion.cam_in_world_m(t_s)
        rays = np.column_stack([np.asarray(colmap_camera(LENS).cam_from_img(xy))[:, :2], np.ones(len(xy))])
        direction = rays @ rotation[1].T
        along = np.stack([(place - centre[1, axis]) / direction[:, axis] for axis, place in PLANES])
        world = centre[1] + np.where(along > 0, along, np.inf).min(axis=0)[:, None] * direction
        ends = [np.asarray(colmap_camera(LENS).img_from_cam((world - centre[k]) @ rotation[k])) for k in (0, 2)]
        return ends[0] - ends[1]

    def centres(self):
        """(F, 3) true camera centres at the instants of the poses."""
        return self.motion.cam_in_world_m(np.array([self.shutter(i).reference_s() for i in range(self.frames)]))

    def write(self, folder: Path, *, metadata=None, extra="", suffix=".jpg"):
        """A capture folder; ``metadata`` changes the bytes of each encoded picture."""
        (folder / "frames").mkdir(parents=True)
        rows = ["name,t_ns"]
        for i in range(self.frames):
            name = f"{i:04}{suffix}"
            bgr = cv2.cvtColor(self.picture(i), cv2.COLOR_RGB2BGR)
            data = cv2.imencode(suffix, bgr, [cv2.IMWRITE_JPEG_QUALITY, 95] if suffix == ".jpg" else [])[1].tobytes()
            (folder / "frames" / name).write_bytes(data if metadata is None else metadata(data))
            rows.append(f"{name},{round(1e9 * self.shutter(i).t_s)}")
        (folder / "frames.csv").write_text("\n".join(rows) + "\n")
        t_s = np.arange(0.0, self.frames / 3 + 0.5, 1 / 200)
        to_imu = matrix_from_quat(CAM_FROM_IMU)
        to_cam = matrix_from_quat(self.motion.world_from_cam_xyzw(t_s))
        force = (
            np.einsum("nji,nj->ni", to_cam, self.motion.at(t_s).accel_in_world_m_s2 + np.array([0, 0, 9.81])) @ to_imu
        )
        rng = np.random.default_rng(1)
        for file, values, sigma in (
            ("gyro", self.motion.rate_in_cam_rad_s(t_s) @ to_imu, 2e-3),
            ("accel", force, 2e-2),
        ):
            values = values + sigma * rng.standard_normal(values.shape)
            table = np.column_stack([t_s + IMU_CLOCK_S, values])
            np.savetxt(folder / f"{file}.csv", table, delimiter=",", header="t,x,y,z", comments="", fmt="%.9g")
        tables = "".join(
            f'[imu.{s}]\nfile = "{s}.csv"\ntime = "t"\ntime_unit = "s"\ncolumns = ["x", "y", "z"]\nunit = "{unit}"\n'
            for s, unit in (("gyro", "rad/s"), ("accel", "m/s2"))
        )
        params = [float(p) for p in LENS.params]
        (folder / "capture.toml").write_text(
            '[images]\nfolder = "frames"\ntimes = "frames.csv"\n'
            f"[timing]\nexposure_s = {self.exposure_s}\nreadout_s = {self.readout_s}\n"
            f'[camera]\nmodel = "PINHOLE"\nwidth = {LENS.width}\nheight = {LENS.height}\nparams = {params}\n'
            f'pixel_origin = "corner"\n{tables}{extra}'
        )
        return folder


#: What a capture.toml says of this camera and IMU where it knows everything.
CALIBRATED = (
    f"[calibration]\ncam_from_imu_xyzw = {CAM_FROM_IMU.tolist()}\ngyro_time_offset_s = {-IMU_CLOCK_S}\n"
    f"accel_time_offset_s = {-IMU_CLOCK_S}\ngyro_bias_rad_s = [0.0, 0.0, 0.0]\n"
)
