"""Speed of the image motion without rotation: close to objects, translation blurs them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from colmap_inertial.core.arrays import Array, UInt8Array
from colmap_inertial.core.types import FrameTiming, Projector
from colmap_inertial.imaging.gyro_camera import FrameShutter, GyroCamera
from colmap_inertial.imaging.rolling_shutter import rays
from colmap_inertial.motion.flow import FlowOptions, GreyFrame, follow_points

#: Share of the points that are slower: as of a frame's blur, which is the 90th percentile over the image.
_PERCENTILE = 90


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedPair:
    """Points that were followed from one frame to the next.

    Attributes
    ----------
    name
        Of the first frame.
    shutters
        Of both.
    points
        (2, N, 2) where they are in the first and the second image, px of the images as they are.
    """

    name: str
    shutters: tuple[FrameShutter, FrameShutter]
    points: Array

    def speed_px_s(self, camera: Projector, motion: GyroCamera | None = None) -> float:
        """Speed of points in the image; with a gyroscope, without the camera's rotation.

        The 90th percentile of their speeds; NaN where the gyroscope did not record all the time between the frames, or
        too few of the points have rays.
        """
        at_s = [shutter.middle_s(points) for shutter, points in zip(self.shutters, self.points, strict=True)]
        first, second = self.points
        if motion is not None:
            begin_s, end_s = (np.array([of(np.concatenate(at_s))]) for of in (np.min, np.max))
            if not motion.covers(begin_s, end_s)[0]:
                return float("nan")
            turn = np.swapaxes(motion.start_from_cam(at_s[1]), -1, -2) @ motion.start_from_cam(at_s[0])
            first = np.asarray(camera.img_from_cam(np.einsum("nij,nj->ni", turn, rays(camera, first))))
        speeds = np.linalg.norm(second - first, axis=1) / np.maximum(at_s[1] - at_s[0], 1e-9)
        known = speeds[np.isfinite(speeds)]
        return float(np.percentile(known, _PERCENTILE)) if len(known) >= FlowOptions().min_support else float("nan")


def follow_pairs(
    frames: Iterable[GreyFrame], timing: FrameTiming, firsts: Collection[str], options: FlowOptions | None = None
) -> Iterator[FollowedPair]:
    """Follow points from some frames to the ones after them; pairs that share too little are left out.

    Parameters
    ----------
    frames
        As of :func:`reduce_frames`, in order of time, all of one size, with those that ``firsts`` names and the ones
        after them; two are held.
    timing
        Holds every frame; its readout, where known, gives each line a time of its own.
    firsts
        The first frame of each pair.
    options
        Number of corners.
    """
    options = options or FlowOptions()
    index = {name: i for i, name in enumerate(timing.names)}
    before: tuple[str, UInt8Array, FrameShutter] | None = None
    for frame in frames:
        shutter = FrameShutter.of(timing, index[frame.name], width=frame.width, height=frame.height)
        if before is not None and before[0] in firsts and index[frame.name] == index[before[0]] + 1:
            followed = next(follow_points(before[1], frame.grey, shutter, options), None)
            if followed is not None:
                yield FollowedPair(name=before[0], shutters=(before[2], shutter), points=np.stack(followed))
        before = frame.name, frame.grey, shutter
