"""A device's path against the cameras of a model: known scales, jumps and bends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import NotObservableError
from colmap_inertial.core.geometry import quat_conjugate, quat_from_matrix, quat_multiply, quat_rotate, so3_exp
from colmap_inertial.core.types import CameraTrajectory
from colmap_inertial.evidence.device_path import join_by_time, place_device_path, up_by_device

#: Of the worlds: anything.
TURN = so3_exp(np.array([0.4, -1.1, 0.8]))


def paths(seed=0, *, count=120, seconds=40.0, metres_per_unit=0.3, walk_m=0.003):
    """A device's path with a random walk, and the model's, in another world and unit."""
    rng = np.random.default_rng(seed)
    t_s = np.linspace(0, seconds, count)
    phase, rate = rng.uniform(0, 6, (2, 3)), rng.uniform(0.2, 0.6, (2, 3))
    centres = np.stack([np.sin(rate[0, k] * t_s + phase[0, k]) for k in range(3)], axis=1) * (1.5, 0.4, 1.2)
    turns = np.stack([0.8 * np.sin(rate[1, k] * t_s + phase[1, k]) for k in range(3)], axis=1)
    xyzw = np.array([quat_from_matrix(so3_exp(turn)) for turn in turns])
    names = tuple(f"{k}.jpg" for k in range(count))
    device = CameraTrajectory(
        names=names,
        t_s=t_s,
        cam_from_world_xyzw=xyzw,
        cam_in_world=centres + np.cumsum(walk_m * rng.normal(size=centres.shape), axis=0),
        epoch_ns=0,
        length_unit="m",
    )
    to_device = np.broadcast_to(quat_from_matrix(TURN), xyzw.shape)
    model = replace(
        device,
        cam_from_world_xyzw=quat_multiply(xyzw, to_device),
        cam_in_world=(centres @ TURN + 5.0) / metres_per_unit,
        length_unit="model",
    )
    return device, model


def codes(placed):
    return [reason.code for reason in placed.evidence.reasons]


def test_scale_and_axes_are_those_of_the_device_and_its_drift_is_the_random_part():
    z = []
    for seed in range(20):
        device, model = paths(seed)
        placed = place_device_path(device, model)
        z.append((placed.evidence.log_scale - math.log(0.3)) / placed.evidence.random_sigma)
        assert codes(placed) == []
        up = up_by_device(placed, np.array([0.0, 1.0, 0.0]))
        assert np.degrees(np.arccos(up @ (TURN.T @ (0, 1, 0)))) < 2
    assert np.mean(np.abs(z) < 1.96) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / 20)


@pytest.mark.parametrize("at", [30, 60, 100])
def test_a_jump_is_found_where_it_is_and_does_not_change_the_scale(at):
    device, model = paths(1)
    jumped = device.cam_in_world.copy()
    jumped[at:] += (0.3, -0.2, 0.1)
    placed = place_device_path(replace(device, cam_in_world=jumped), model)
    (fact,) = placed.evidence.reasons
    assert fact.code == "device-path-breaks"
    assert fact.values["at_s"] == pytest.approx(0.5 * (device.t_s[at - 1] + device.t_s[at]), abs=0.5)
    assert fact.values["jump_m"] == pytest.approx(math.sqrt(0.14), abs=0.05)
    assert placed.evidence.log_scale == pytest.approx(math.log(0.3), abs=3 * placed.evidence.random_sigma)


def test_a_sudden_turn_of_the_model_is_a_break():
    device, model = paths(2)
    twist = quat_from_matrix(so3_exp(np.array([0.0, 0.0, 0.3])))
    xyzw = model.cam_from_world_xyzw.copy()
    xyzw[70:] = quat_multiply(xyzw[70:], np.broadcast_to(twist, xyzw[70:].shape))
    assert "device-path-breaks" in codes(place_device_path(device, replace(model, cam_from_world_xyzw=xyzw)))


def bent(model, axis, angle_rad):
    """The model with its world turned more and more along the path; the path follows."""
    share = np.linspace(0, 1, len(model))
    turns = np.array([quat_from_matrix(so3_exp(angle_rad * s * np.asarray(axis))) for s in share])
    steps = np.diff(model.cam_in_world, axis=0)
    turned = np.array([quat_rotate(turn, step) for turn, step in zip(turns[1:], steps, strict=True)])
    centres = np.vstack([model.cam_in_world[:1], model.cam_in_world[0] + np.cumsum(turned, axis=0)])
    xyzw = quat_multiply(model.cam_from_world_xyzw, quat_conjugate(turns))
    return replace(model, cam_in_world=centres, cam_from_world_xyzw=xyzw)


def test_a_bend_is_named_and_one_of_the_vertical_sooner_than_one_of_the_heading():
    device, model = paths(3)
    up = np.array([0.0, 1.0, 0.0])
    heading, level = TURN.T @ up, TURN.T @ (1.0, 0.0, 0.0)
    assert codes(place_device_path(device, bent(model, heading, 0.15), up_in_device=up)) == ["device-path-bends"]
    assert codes(place_device_path(device, bent(model, level, 0.08), up_in_device=up)) == ["device-path-bends"]
    assert codes(place_device_path(device, bent(model, heading, 0.06), up_in_device=up)) == []


def test_the_drift_of_the_device_s_scale_shows_in_its_parts():
    device, model = paths(4, walk_m=0.0)
    step = np.diff(device.cam_in_world, axis=0)
    step[60:] *= 0.95
    shrunk = np.vstack([device.cam_in_world[:1], device.cam_in_world[0] + np.cumsum(step, axis=0)])
    spans = ((0.0, 20.0), (20.5, 40.0))
    placed = place_device_path(replace(device, cam_in_world=shrunk), model, parts=spans)
    first, second = placed.evidence.parts
    assert first.log_scale == pytest.approx(math.log(0.3), abs=1e-3)
    assert second.log_scale - first.log_scale == pytest.approx(math.log(0.95), abs=2e-3)


def refused(device, model):
    with pytest.raises(NotObservableError) as error:
        place_device_path(device, model)
    return error.value.fact.code


def test_what_cannot_be_compared_is_said():
    device, model = paths(5, count=30)
    assert refused(replace(device, names=tuple("x" + name for name in device.names)), model) == "device-poses-too-few"
    assert refused(replace(device, cam_in_world=0 * device.cam_in_world), model) == "device-stands-still"


def test_poses_are_met_by_time():
    device, _ = paths(6, count=10, seconds=9.0)
    t_ns = np.rint(1e9 * np.array([0.02, 0.4, 3.97, 4.01, 20.0])).astype(np.int64)
    found = join_by_time(device, list("abcde"), t_ns, within_s=0.1)
    assert found == {"a": "0.jpg", "c": "4.jpg"}
