"""Recordings with something wrong, through the command: an error that names the setting, a refusal, or a right scale.

Nothing is ever trusted and wrong. The recordings are real (18 to 60 s of one of Mustaniemi et al., IROS 2017).
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.cli import main
from colmap_inertial.core.geometry import so3_exp

NAME, SECONDS, OTHER = "D11", 18.0, "D5"
GYRO, ACCEL, POSES = "gyroscope", "accelerometer", "poses"
Tables = dict[str, np.ndarray]


def values(sensor: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Tables], None]:
    def alter(tables: Tables) -> None:
        tables[sensor][:, 1:] = change(tables[sensor][:, 1:])

    return alter


def stamps(sensors: tuple[str, ...], change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Tables], None]:
    def alter(tables: Tables) -> None:
        for sensor in sensors:
            tables[sensor][:, 0] = change(tables[sensor][:, 0])

    return alter


def turned(rotation_vector: list[float]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: x @ so3_exp(np.array(rotation_vector)).T


def without(*, begin_s: float, length_s: float, sensors: tuple[str, ...] = (GYRO, ACCEL)) -> Callable[[Tables], None]:
    def alter(tables: Tables) -> None:
        for sensor in sensors:
            t_s = (tables[sensor][:, 0] - tables[POSES][0, 0]) * 1e-9
            tables[sensor] = tables[sensor][(t_s < begin_s) | (t_s > begin_s + length_s)]

    return alter


def repeated(tables: Tables) -> None:
    for sensor in (GYRO, ACCEL):
        tables[sensor] = np.repeat(tables[sensor], np.where(np.arange(len(tables[sensor])) % 50 == 7, 2, 1), axis=0)


def jumping(tables: Tables) -> None:
    rng = np.random.default_rng(1)
    size = np.ptp(tables[POSES][:, 1:4], axis=0).max()
    for i in rng.integers(0, len(tables[POSES]) - 3, 5):
        tables[POSES][i : i + 3, 1:4] += 0.2 * size * rng.standard_normal(3)


def broken(tables: Tables) -> None:
    size = np.ptp(tables[POSES][:, 1:4], axis=0).max()
    tables[POSES][len(tables[POSES]) // 2 :, 1:4] += 0.1 * size * np.array([1, 0.5, -0.3])


def weightless(tables: Tables) -> None:
    tables[ACCEL][:, 1:] -= filtered(filtered(tables[ACCEL][::-1, 1:], hz=0.3)[::-1], hz=0.3)


def filtered(force: np.ndarray, hz: float = 4.0) -> np.ndarray:
    """A low-pass filter of the first order, at 100 readings a second."""
    out, keep = force.copy(), np.exp(-2 * np.pi * hz / 100)
    for i in range(1, len(out)):
        out[i] = keep * out[i - 1] + (1 - keep) * out[i]
    return out


@pytest.fixture(scope="module")
def source(shared_data):
    """The recording's folder and its tables. Tests must not change them."""
    folder = shared_data / "inertial_scale" / NAME
    return folder, {kind: np.loadtxt(folder / f"{kind}.txt") for kind in (POSES, GYRO, ACCEL)}


@pytest.fixture
def attempt(source, tmp_path, capsys):
    """Runs the command on an altered copy; gives exit code, message and the JSON (None where there is none)."""

    def run(alter: Callable[[Tables], None], *options: str, seconds: float = SECONDS):
        original, recorded = source
        tables = {kind: table.copy() for kind, table in recorded.items()}
        tables[POSES] = tables[POSES][tables[POSES][:, 0] <= tables[POSES][0, 0] + seconds * 1e9]
        alter(tables)
        folder = tmp_path / NAME
        folder.mkdir(exist_ok=True)
        for kind, table in tables.items():
            if np.array_equal(table, recorded[kind]):
                shutil.copy(original / f"{kind}.txt", folder)
            else:
                np.savetxt(folder / f"{kind}.txt", table, fmt=["%d"] + ["%.9g"] * (table.shape[1] - 1))
        target = tmp_path / "scale.json"
        with pytest.raises(SystemExit) as stopped:
            main(["scale", str(folder), "--json", str(target), *options])
        truth = float((original / "groundtruth.txt").read_text())
        estimate = json.loads(target.read_text()) if target.exists() else None
        if estimate is not None and estimate["verdict"] == "trusted":
            low, high = estimate["ci95"]
            assert low <= truth <= high, "trusted and wrong"
        return stopped.value.code, capsys.readouterr().err, estimate

    return run


@pytest.mark.parametrize(
    ("alter", "setting"),
    [
        pytest.param(values(GYRO, np.degrees), 'unit = "deg/s" under [imu.gyro]', id="gyro-in-deg/s"),
        pytest.param(values(ACCEL, lambda x: x / 9.80665), 'unit = "g" under [imu.accel]', id="accel-in-g"),
        pytest.param(values(GYRO, np.negative), 'axes = "-x,-y,-z" and mirrored = true', id="gyro-sign"),
        pytest.param(weightless, "[imu.accel]", id="no-gravity"),
        pytest.param(values(GYRO, turned([0, 0, np.pi / 2])), 'axes = "y,-x,z" under [imu.gyro]', id="gyro-turned"),
        pytest.param(values(ACCEL, turned([0, 0, np.pi / 2])), "axes = ", id="accel-turned"),
        pytest.param(values(GYRO, lambda x: x * [-1, 1, 1]), 'axes = "-x,y,z" and mirrored = true', id="gyro-mirrored"),
        pytest.param(
            values(ACCEL, lambda x: x * [-1, 1, 1]), 'axes = "-x,y,z" and mirrored = true', id="accel-mirrored"
        ),
        pytest.param(values(GYRO, lambda x: x[:, [1, 0, 2]]), 'axes = "y,x,z" and mirrored = true', id="gyro-columns"),
        pytest.param(values(ACCEL, lambda x: x * [0, 1, 1]), "columns of [imu.accel]", id="dead-accel-x"),
        pytest.param(values(ACCEL, lambda x: x * [1, 1, 0]), "columns of [imu.accel]", id="dead-accel-z"),
        pytest.param(values(GYRO, lambda x: x * [1, 0, 1]), "columns of [imu.gyro]", id="dead-gyro-y"),
        pytest.param(values(GYRO, lambda x: x * 0), "[imu.gyro]", id="dead-gyro"),
    ],
)
def test_a_wrong_file_is_an_error_that_names_the_setting(attempt, alter, setting):
    code, message, estimate = attempt(alter)
    assert code == 2 and estimate is None
    assert setting in " ".join(message.split())


def test_axes_to_write_take_the_place_of_those_declared(tmp_path, capsys):
    desk = Path(__file__).parents[3] / "example_scenes" / "desk"
    scene = shutil.copytree(desk, tmp_path / "desk")
    table = (scene / "capture.toml").read_text()
    (scene / "capture.toml").write_text(table.replace("[imu.gyro]", '[imu.gyro]\naxes = "y,z,x"'))
    frames = json.loads((desk / "truth.json").read_text())["frames"]
    with (tmp_path / "poses.txt").open("w") as poses:
        for frame in frames:
            x, y, z, w = frame["cam_from_world_xyzw"]
            print(frame["t_middle_s"], *frame["cam_in_world_m"], -x, -y, -z, w, file=poses)
    with pytest.raises(SystemExit) as stopped:
        main(["scale", str(tmp_path / "poses.txt"), "--imu", str(scene)])
    shown = capsys.readouterr()
    assert stopped.value.code == 3
    assert 'set axes = "x,y,z" under [imu.gyro]' in " ".join((shown.out + shown.err).replace("│", " ").split())


@pytest.mark.parametrize(
    "alter",
    [
        pytest.param(values(ACCEL, np.negative), id="accel-sign"),
        pytest.param(stamps((ACCEL,), lambda t: t + 1000e9), id="sensors-1000-s-apart"),
    ],
)
def test_a_recording_that_cannot_give_a_scale_is_refused(attempt, alter):
    code, _, estimate = attempt(alter)
    assert code == 3 and estimate["verdict"] == "refused" and estimate["metres_per_unit"] is None
    assert estimate["reasons"]


def test_the_imu_of_another_recording_is_refused(attempt, shared_data):
    def exchange(tables: Tables) -> None:
        for sensor in (GYRO, ACCEL):
            tables[sensor] = np.loadtxt(shared_data / "inertial_scale" / OTHER / f"{sensor}.txt")

    code, _, estimate = attempt(exchange)
    assert code == 3 and "belongs to these images" in estimate["reasons"][0]


@pytest.mark.parametrize(
    ("alter", "said"),
    [
        pytest.param(lambda tables: None, "", id="clean"),
        pytest.param(stamps((GYRO, ACCEL), lambda t: t + 1000e9), "clocks do not overlap", id="stamps-1000-s-apart"),
        pytest.param(without(begin_s=12.0, length_s=0.05), "pauses once, for 0.06 s", id="gap-0.05-s"),
        pytest.param(without(begin_s=12.0, length_s=1.0), "gyroscope pauses once, for 1.0", id="gap-1-s"),
        pytest.param(without(begin_s=9.0, length_s=3.5, sensors=(ACCEL,)), "accelerometer pauses once", id="gap-3.5-s"),
        pytest.param(repeated, "repeated gyroscope rows", id="duplicates"),
        pytest.param(jumping, "poses jump at", id="pose-jumps"),
        pytest.param(broken, "poses jump at", id="path-breaks"),
    ],
)
def test_what_recordings_suffer_is_handled_and_listed(attempt, alter, said):
    code, message, estimate = attempt(alter)
    assert code == 0, message
    assert estimate["verdict"] == "trusted" and estimate["reasons"] == []
    assert said in " ".join(estimate["notes"])


@pytest.mark.parametrize("faster", [1.01, 0.99])
def test_clocks_that_part_are_both_suspected(attempt, shared_data, faster):
    truth = float((shared_data / "inertial_scale" / NAME / "groundtruth.txt").read_text())
    _, _, estimate = attempt(stamps((GYRO, ACCEL), lambda t: t[0] + faster * (t - t[0])))
    _, _, camera = attempt(stamps((POSES,), lambda t: t[0] + faster * (t - t[0])))
    assert any("ppm off the camera's" in note for note in estimate["notes"])
    for one in (estimate, camera):
        assert one["verdict"] == "weak" and one["reasons_details"][0]["code"] == "clocks-run-apart"
        assert one["ci95"][0] <= truth <= one["ci95"][1]
        assert one["parts"]["clocks"] == pytest.approx(2 * 0.01, rel=0.03)


@pytest.mark.parametrize(
    "alter",
    [
        pytest.param(values(ACCEL, lambda x: 1.1 * x), id="gain"),
        pytest.param(values(ACCEL, lambda x: x * [1.1, 1, 1]), id="gain-of-one-axis"),
        pytest.param(values(GYRO, turned([0, 0.5, 0])), id="gyro-turned-by-30-degrees"),
    ],
)
def test_a_badly_calibrated_imu_is_not_trusted(attempt, alter):
    _, _, estimate = attempt(alter, seconds=20.0)
    assert estimate["verdict"] != "trusted" and estimate["reasons"]


def late(force: np.ndarray) -> np.ndarray:
    """The second axis one reading (10 ms) late."""
    return np.stack([force[:, 0], np.roll(force[:, 1], 1), force[:, 2]], axis=1)


@pytest.mark.parametrize(
    ("alter", "seconds", "said"),
    [
        pytest.param(values(ACCEL, filtered), 30.0, "low-passed at about", id="low-pass-4-Hz"),
        pytest.param(values(ACCEL, late), 60.0, "axes are sampled at different times", id="axis-late"),
        pytest.param(
            stamps((ACCEL,), lambda t: t[0] + 1.001 * (t - t[0])), 30.0, "ppm off the gyroscope's", id="accel-rate"
        ),
        pytest.param(values(ACCEL, lambda x: 1.05 * x), 40.0, "gain error is", id="gain-5-%"),
        pytest.param(values(ACCEL, lambda x: x * [1.05, 1, 1]), 30.0, "gain error is", id="gain-5-%-of-one-axis"),
        pytest.param(values(ACCEL, lambda x: np.clip(x, -11, 11)), 30.0, "readings are saturated and", id="saturated"),
    ],
)
def test_what_is_wrong_with_the_accelerometer_is_named_and_undone(attempt, shared_data, alter, seconds, said):
    code, message, estimate = attempt(alter, "--force", seconds=seconds)
    assert code == 0, message
    (named,) = (sentence for sentence in (*estimate["reasons"], *estimate["notes"]) if said in sentence)
    assert estimate["verdict"] == "weak" or "included in the interval" in named
    truth = float((shared_data / "inertial_scale" / NAME / "groundtruth.txt").read_text())
    assert estimate["ci95"][0] <= truth <= estimate["ci95"][1]
    assert estimate["ci95"][1] / estimate["ci95"][0] < 1.05
