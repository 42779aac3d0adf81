"""An exposure that nobody states is found from rendered blur, bounded without blur, refused where little tells."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.types import CameraModel
from colmap_inertial.imaging.exposure import compare_exposures, estimate_exposure, exposures_to_compare
from colmap_inertial.imaging.gyro_camera import FrameShutter
from colmap_inertial.tools.simulate.render import colmap_camera
from tests.helpers.far_scene import FarScene

CAMERA = CameraModel(model="PINHOLE", width=640, height=480, params=(520.0, 520.0, 320.0, 240.0))
EXPOSURES_S = exposures_to_compare(0.06)
SHUTTER = FrameShutter(width=640, height=480, t_s=0.0, exposure_s=None, readout_s=0.015)


@pytest.fixture(scope="module")
def scene() -> FarScene:
    return FarScene.make(6, vigour=1.5, size=2000)


def compared(scene: FarScene, exposure_s: float, *, along: float = 0.0) -> list[np.ndarray]:
    """Frames of one exposure; all smeared alike by a lens, by so many pixels from left to right."""
    motion, camera = scene.gyro(noise_rad_s=0.002), colmap_camera(CAMERA)
    out = []
    for i, middle_s in enumerate(np.linspace(0.5, 5.5, 14)):
        shutter = replace(SHUTTER, exposure_s=exposure_s, t_s=middle_s - 0.5 * exposure_s)
        image = scene.picture(CAMERA, shutter, samples=24, noise=0.004, seed=i)
        if along:
            width = int(along)
            image = np.rint(np.mean([np.roll(image.astype(float), k, axis=1) for k in range(width)], axis=0)).astype(
                np.uint8
            )
        one = compare_exposures(image, motion, camera, replace(SHUTTER, t_s=middle_s), EXPOSURES_S)
        if one is not None:
            out.append(one)
    return out


@pytest.mark.parametrize("exposure_s", [0.012, 0.03])
def test_an_exposure_is_found_by_the_blur_of_frames_that_turn_at_several_speeds(
    scene: FarScene, exposure_s: float
) -> None:
    found = estimate_exposure(compared(scene, exposure_s), EXPOSURES_S)
    assert found.exposure_s is not None and found.sigma_s is not None
    assert abs(found.exposure_s - exposure_s) < 3 * found.sigma_s
    assert found.exposure_s < found.most_s


def test_a_lens_that_smears_all_frames_alike_is_no_exposure(scene: FarScene) -> None:
    found = estimate_exposure(compared(scene, 0.0005, along=3.0), EXPOSURES_S)
    assert found.exposure_s is None and found.sigma_s is None
    assert found.most_s < 0.012


def test_frames_that_are_few_or_hardly_turn_tell_no_exposure(scene: FarScene) -> None:
    with pytest.raises(NotObservableError) as few:
        estimate_exposure(compared(scene, 0.02)[:5], EXPOSURES_S)
    assert few.value.code == "exposure-of-few-frames"
    still = replace(scene, motion=FarScene.make(6, vigour=0.002, size=8).motion)
    with pytest.raises(NotObservableError) as none:
        estimate_exposure(compared(still, 0.02), EXPOSURES_S)
    assert none.value.code == "exposure-not-bounded"


def test_a_frame_beyond_the_gyroscope_tells_nothing(scene: FarScene) -> None:
    image = np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8)
    late = replace(SHUTTER, t_s=5.99)
    assert compare_exposures(image, scene.gyro(), colmap_camera(CAMERA), late, EXPOSURES_S) is None
