"""Camera models of sensor.yaml."""

import pycolmap

from colmap_inertial.io.sensor_yaml import CAMERA_MODELS


def test_camera_models_are_colmap_s(subtests):
    known = pycolmap.CameraModelId.__members__
    assert len(known) > 10
    # the lowest pycolmap lacks the latest ones
    for number, (name, (count, principal)) in enumerate((k, v) for k, v in CAMERA_MODELS.items() if k in known):
        with subtests.test(name):
            camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
            assert int(camera.model) == number
            assert len(camera.params) == count
            assert camera.principal_point_idxs()[0] == principal
