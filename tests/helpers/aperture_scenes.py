"""Scenes for multi-aperture cameras whose disparities are known."""

import numpy as np

from colmap_inertial.core.types import Aperture, ApertureRig, CameraModel
from colmap_inertial.model import colmap_camera

FLAT = np.array([0.0, 0.0, 0.0, 1.0])
ROLES = ("green", "red", "blue", "luminance")
PLACES = ((0, 0), (1, 0), (0, 1), (1, 1))


def four_apertures(width, height, roles=ROLES, baseline_m=0.01, focal_px=500.0):
    """A square of apertures that look the same way."""
    camera = CameraModel(
        model="PINHOLE", width=width, height=height, params=(focal_px, focal_px, width / 2, height / 2)
    )
    apertures = [
        Aperture(
            name=role,
            role=role,
            camera=camera,
            cam_from_rig_xyzw=FLAT,
            cam_in_rig=baseline_m * np.array([*place, 0.0]),
        )
        for role, place in zip(roles, PLACES, strict=True)
    ]
    return ApertureRig(apertures=tuple(apertures))


def projectors(rig):
    return [colmap_camera(aperture.camera) for aperture in rig.apertures]


def texture(width, height, seed):
    """Codes of a smooth random pattern with detail of a few pixels."""
    import cv2

    rng = np.random.default_rng(seed)
    pattern = sum(
        s * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), s, borderType=cv2.BORDER_REFLECT)
        for s in (1.5, 3, 8)
    )
    pattern = (pattern - pattern.mean()) / pattern.std()
    return np.clip(128 + 45 * pattern, 0, 255)


def plane_views(width, height, middle_px, slope, colours=None):
    """Pictures of a plane: the reference's disparity is ``middle_px + slope (x - width / 2, y - height / 2)``.

    Returns the four pictures, (H, W) truth and the rig. ``colours``: patterns of green, red, blue, of which luminance
    is the mean; by default all see the same pattern by another curve.
    """
    import cv2

    if colours is None:
        pattern = texture(width + 80, height + 80, seed=0) / 255
        patterns = [255 * pattern**power for power in (1.0, 0.7, 1.6, 1.2)]
    else:
        patterns = [cv2.resize(c, (width + 80, height + 80), interpolation=cv2.INTER_CUBIC) for c in colours]
        patterns.append(sum(patterns) / 3)
    y, x = np.mgrid[:height, :width].astype(float)

    def disparity(u, v):
        return middle_px + slope[0] * (u - width / 2) + slope[1] * (v - height / 2)

    pictures = []
    for (dx, dy), pattern in zip(PLACES, patterns, strict=True):
        u, v = x.copy(), y.copy()  # where the reference sees what this view sees at (x, y)
        for _ in range(50):
            d = disparity(u, v)
            u, v = x + dx * d, y + dy * d
        at = (np.float32(u + 40), np.float32(v + 40))
        seen = cv2.remap(pattern.astype(np.float32), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        pictures.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
    return pictures, disparity(x, y), four_apertures(width, height)


def psnr_db(a, b):
    error = np.mean((np.asarray(a, dtype=float) - np.asarray(b, dtype=float)) ** 2)
    return 10 * np.log10(255**2 / max(error, 1e-9))


def read_pfm(path):
    """(H, W) of a grey PFM."""
    with open(path, "rb") as file:
        assert file.readline().strip() == b"Pf"
        width, height = map(int, file.readline().split())
        order = "<" if float(file.readline()) < 0 else ">"
        return np.fromfile(file, f"{order}f4").reshape(height, width)[::-1].astype(np.float64)
