"""Where on Earth a model stands: positions of a satellite receiver, read and fitted, against known truth."""

import csv
import json
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.earth import ecef_from_enu, ecef_of_geodetic, geodetic_of_ecef
from colmap_inertial.core.errors import FormatError, NotObservableError
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.core.types import CameraTrajectory, PositionFixes
from colmap_inertial.evidence.positions import located, path_at
from colmap_inertial.inertial.georeference import Georeference, georeference, georeference_of_json
from colmap_inertial.io.positions import positions_in_pictures, positions_in_video
from colmap_inertial.model import read_model
from colmap_inertial.report.words import place_facts
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.preparation.geolocation import read_georeference
from colmap_inertial.tools.export.whole import export_model
from scripts.studies.georeference import measure
from tests.helpers import imu_files
from tests.helpers.box_project import build
from tests.helpers.position_walks import UP, Walk, geodetic_of_enu, turn, walk
from tests.helpers.simulated_imu import recorded

# --- the Earth -------------------------------------------------------------------------------------------------------


def test_coordinates_are_those_of_proj():
    pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed (extra las)")
    rng = np.random.default_rng(0)
    places = np.stack([rng.uniform(-90, 90, 50), rng.uniform(-180, 180, 50), rng.uniform(-400, 9000, 50)], axis=1)
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    ecef = ecef_of_geodetic(places)
    np.testing.assert_allclose(ecef, np.stack(there.transform(*places[:, [1, 0, 2]].T), axis=1), atol=1e-6)
    np.testing.assert_allclose(geodetic_of_ecef(ecef), places, atol=1e-7)
    # east, north, up of PROJ's own topocentric operation
    lat, lon, height = places[7]
    local = pyproj.Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 +lat_0={lat} +lon_0={lon} +h_0={height}")
    enu = (ecef - ecef[7]) @ ecef_from_enu(lat, lon)
    np.testing.assert_allclose(enu, np.stack(local.transform(*ecef.T), axis=1), atol=1e-6)


# --- the fit ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "errors",
    [{}, {"white_m": 0.1, "slow_m": 3.0}, {"white_m": 1.0, "slow_m": 2.0, "seconds": 120}, {"seconds": 25}],
    ids=["white", "slow", "both", "short"],
)
def test_heading_and_place_lie_within_their_intervals(errors):
    walks = [walk(seed, **errors) for seed in range(40)]
    found = [one.fitted() for one in walks]
    heading = np.array([one.heading_error_deg(f) for one, f in zip(walks, found, strict=True)])
    sigma = np.array([f.heading_sigma_deg for f in found])
    place = np.array([one.place_error_m(f) for one, f in zip(walks, found, strict=True)])
    across = np.array([f.position_sigma_m for f in found])
    assert np.mean(np.abs(heading) < 1.96 * sigma) >= 0.9
    assert np.mean(np.abs(place[:, :2]) < 1.96 * across[:, None]) >= 0.9
    assert np.mean(np.abs(place[:, 2]) < 1.96 * np.sqrt([f.cov[3, 3] for f in found])) >= 0.9
    # and are no wider than they have to be: three times the errors at most, what a slow error could do beside it
    assert np.median(sigma) < 3 * np.sqrt(np.mean(heading**2))
    if not errors:
        assert np.median([f.residual_rms_m for f in found]) == pytest.approx(3.0, rel=0.1)
        assert np.median(sigma) < 2


def test_intervals_hold_however_long_errors_are_alike(subtests):
    """The study by scripts/studies/georeference.py, smaller."""
    for slow_m, alike_s in ((3.0, 5.0), (1.0, 20.0), (6.0, 60.0), (3.0, 300.0)):
        with subtests.test(slow_m=slow_m, alike_s=alike_s):
            row = measure(slow_m, alike_s, walks=12, stated=True, seed=5)
            for name in ("place", "heading"):
                assert row[f"{name}_covered"] >= 0.83, (name, row)
                assert row[f"{name}_ratio"] < 4, (name, row)


def test_a_correlation_that_the_positions_do_not_show_is_said_to_be_assumed():
    # 90 s of errors that are alike over 300 s are a shift; ten minutes of errors alike over 5 s show it
    short = [walk(seed, slow_m=3.0, alike_s=300.0, white_m=3.0, seconds=90).fitted() for seed in range(6)]
    assert sum(one.alike_assumed for one in short) >= 4
    long = [walk(seed, slow_m=3.0, alike_s=5.0, white_m=0.1, seconds=200).fitted() for seed in range(6)]
    assert not any(one.alike_assumed for one in long)
    assert 2.5 < np.median([one.alike_s for one in long]) < 10
    assert (
        "assumed" in dict(place_facts(next(one for one in short if one.alike_assumed).as_json()))["errors of positions"]
    )
    assert "assumed" not in dict(place_facts(long[0].as_json()))["errors of positions"]


def late(seed, *, pace_m_s, turning, delay_s, seconds=90, rate_hz=1.0, white_m=3.0):
    """A path of small steps, and positions that are those of a moment before: a walk and its path at any instant."""
    rng = np.random.default_rng(seed)
    fine_s = np.arange(-5.0, seconds + 5.0, 0.05)
    # turns and changes of pace that last some seconds, as of a person
    swings = [
        rng.normal(0, 1, (2, 1)) * np.sin(2 * np.pi * (fine_s / rng.uniform(8, 40) + rng.random())) for _ in "abcd"
    ]
    course = turning * sum(one[0] for one in swings) + rng.uniform(-np.pi, np.pi)
    pace = pace_m_s * (1 + 0.3 * turning * np.tanh(sum(one[1] for one in swings)))
    step = pace * np.stack([np.cos(course), np.sin(course), np.zeros_like(course)]) * 0.05
    path = np.cumsum(step, axis=1).T
    t_s = np.arange(0.0, seconds, 1 / rate_hz)

    def at(when_s):
        return np.stack([np.interp(when_s, fine_s, path[:, k]) for k in range(3)], axis=1)

    heading, origin = rng.uniform(-np.pi, np.pi), (rng.uniform(-70, 70), rng.uniform(-179, 179), 50.0)
    shown = at(t_s - delay_s) @ turn(heading).T + white_m * rng.standard_normal((len(t_s), 3))
    place = geodetic_of_enu(shown, origin)
    fixes = PositionFixes(
        latitude_deg=place[:, 0],
        longitude_deg=place[:, 1],
        height_m=place[:, 2],
        sigma_m=np.full(len(t_s), np.nan),
        t_ns=(t_s * 1e9).astype(np.int64),
        height_above="ellipsoid",
    )
    one = Walk(path_m=at(t_s), t_s=t_s, heading_rad=heading, origin=origin, fixes=fixes)
    return one, georeference(fixes, one.path_m, t_s, UP, path_at=at)


@pytest.mark.parametrize(
    ("pace_m_s", "turning", "most_sigma_s"),
    [(1.4, 1.0, 0.27), (5.0, 1.0, 0.13), (5.0, 0.0, 0.31)],
    ids=["walking", "cycling", "straight"],
)
def test_positions_that_lag_are_known_to(pace_m_s, turning, most_sigma_s):
    walks, found = zip(
        *(late(seed, pace_m_s=pace_m_s, turning=turning, delay_s=0.5) for seed in range(24)), strict=True
    )
    heading = np.array([one.heading_error_deg(f) for one, f in zip(walks, found, strict=True)])
    assert np.mean(np.abs(heading) < 1.96 * np.array([f.heading_sigma_deg for f in found])) >= 0.9
    delay, sigma = (np.array([getattr(f, name) for f in found]) for name in ("delay_s", "delay_sigma_s"))
    assert np.mean(np.abs(delay - 0.5) < 1.96 * sigma) >= 0.9
    assert np.median(sigma) < most_sigma_s
    assert np.median([f.residual_rms_m for f in found]) == pytest.approx(3.0, rel=0.1)
    place = np.array([one.place_error_m(f)[:2] for one, f in zip(walks, found, strict=True)])
    # 95 % of two coordinates
    inside = [p @ np.linalg.solve(f.cov[1:3, 1:3], p) < 5.99 for p, f in zip(place, found, strict=True)]
    assert np.mean(inside) >= 0.9
    if not turning:
        # nothing tells: what is known beforehand, and its part of the place along the path
        assert np.median(sigma) > 0.29
        along = [np.sqrt(np.linalg.eigvalsh(f.cov[1:3, 1:3])[1]) for f in found]
        assert np.median(along) > 0.29 * pace_m_s


def test_exact_positions_tell_their_delay_exactly(subtests):
    for delay_s in (0.0, 0.25, 1.1):
        with subtests.test(delay_s=delay_s):
            one, found = late(3, pace_m_s=5.0, turning=1.0, delay_s=delay_s, seconds=60, white_m=0.02, rate_hz=5.0)
            assert found.delay_sigma_s < 0.01
            assert abs(found.delay_s - delay_s) < 3 * found.delay_sigma_s
            assert np.linalg.norm(one.place_error_m(found)[:2]) < 4 * found.position_sigma_m
            assert found.residual_rms_m == pytest.approx(0.02, rel=0.2)
            assert found.length_ratio == pytest.approx(1.0, abs=4 * found.length_ratio_sigma)


def test_the_path_goes_straight_on_between_and_beyond_its_images():
    path = CameraTrajectory(
        names=("a", "b", "c"),
        t_s=np.array([0.0, 1.0, 3.0]),
        cam_from_world_xyzw=np.tile([0.0, 0, 0, 1], (3, 1)),
        cam_in_world=np.array([[0.0, 0, 0], [1, 2, 3], [1, 2, 7]]),
    )
    at = path_at(path)(np.array([-0.5, 0.5, 2.0, 4.0]))
    np.testing.assert_allclose(at, [[-0.5, -1, -1.5], [0.5, 1, 1.5], [1, 2, 5], [1, 2, 9]])


def test_the_scale_is_never_touched_and_a_wrong_one_is_named():
    one = walk(3, white_m=0.5, length=1.3)
    found = one.fitted()
    np.testing.assert_allclose(found.enu_from_world @ found.enu_from_world.T, np.eye(3), atol=1e-12)
    assert found.length_ratio == pytest.approx(1.3, abs=4 * found.length_ratio_sigma)
    assert "times as far apart" in str(found.notes[0]) and "scale is unchanged" in str(found.notes[0])
    sound = walk(3, white_m=0.5)
    (note,) = sound.fitted().notes
    assert note.code == "accuracy-assumed"
    stated = replace(sound, fixes=replace(sound.fixes, sigma_m=np.ones(len(sound.t_s))))
    assert stated.fitted().notes == ()


def test_positions_of_another_path_and_of_a_receiver_that_stood_still_are_refused():
    one = walk(8, white_m=1.0)
    still = one.fixes.select(np.zeros(60, dtype=int))
    with pytest.raises(NotObservableError, match="another path"):
        georeference(still, one.path_m, one.t_s, UP)
    # the walker went straight on, the receiver around in a circle
    angle = 2 * np.pi * one.t_s / 60
    around = geodetic_of_enu(20 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), one.origin)
    other = replace(one.fixes, latitude_deg=around[:, 0], longitude_deg=around[:, 1])
    with pytest.raises(NotObservableError):
        georeference(other, one.path_m, one.t_s, UP)


def test_any_up_will_do():
    one = walk(4, white_m=0.01)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up becomes y down
    turned = Walk(**{**vars(one), "path_m": one.path_m @ down.T})
    found = turned.fitted(up=np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(found.ecef_m(turned.path_m), one.fitted().ecef_m(one.path_m), atol=1e-6)


def test_jumps_are_left_out():
    one = walk(5, white_m=1.0, jumps=6)
    found = one.fitted()
    assert found.left_out == 6
    assert abs(one.heading_error_deg(found)) < 2 * found.heading_sigma_deg < 6


def test_a_path_too_short_for_a_heading_is_refused_and_too_few_positions():
    with pytest.raises(NotObservableError, match="walk farther"):
        walk(6, steps=0.03).fitted()
    one = walk(6)
    few = Walk(**{**vars(one), "fixes": one.fixes.select(np.arange(3)), "path_m": one.path_m[:3], "t_s": one.t_s[:3]})
    with pytest.raises(NotObservableError, match="too few"):
        few.fitted()


def test_it_comes_back_from_its_json():
    found = walk(7).fitted()
    for one in (found, replace(found, delay_s=0.4, delay_sigma_s=0.1)):
        again = georeference_of_json(json.loads(json.dumps(one.as_json())))
        assert again.as_json() == one.as_json()


def test_no_place_on_earth_is_taken_from_a_file(subtests, tmp_path_factory):
    for key, value in (
        ("latitude_deg", "91"),
        ("longitude_deg", "1e300"),
        ("longitude_deg", "1e999"),
        ("height_m", "1e999"),
    ):
        with subtests.test(key=key, value=value):
            tmp_path = tmp_path_factory.mktemp("given")
            content = walk(7).fitted().as_json()
            content["origin"][key] = 123456789
            text = json.dumps({"models": [{"model": 0, **content}]}).replace("123456789", value)
            (tmp_path / "georeference.json").write_text(text)
            with pytest.raises(FormatError, match=r"was changed since it was written|1e999 is not a supported number"):
                read_georeference(tmp_path / "georeference.json", 0)


def test_positions_meet_the_path_by_name_or_by_time():
    path = CameraTrajectory(
        names=("a", "b", "c"),
        t_s=np.array([0.0, 1.0, 5.0]),
        epoch_ns=2_000_000_000,
        cam_from_world_xyzw=np.tile([0.0, 0, 0, 1], (3, 1)),
        cam_in_world=np.array([[0.0, 0, 0], [1, 2, 3], [9, 9, 9]]),
    )
    nothing = {"latitude_deg": np.zeros(4), "longitude_deg": np.zeros(4), "height_m": np.zeros(4)}
    timed = PositionFixes(**nothing, sigma_m=np.ones(4), t_ns=np.array([1_900, 2_500, 4_000, 9_000]) * 1_000_000)
    here, at, t_s = located(timed, path)  # one is too early, one in a gap, one too late
    np.testing.assert_allclose(at, [[0.5, 1, 1.5]])
    np.testing.assert_allclose(t_s, [0.5])
    assert len(here.latitude_deg) == 1
    named = PositionFixes(**nothing, sigma_m=np.ones(4), names=("x", "c", "a", "y"))
    here, at, t_s = located(named, path)
    assert here.names == ("c", "a")
    np.testing.assert_allclose(at, [[9, 9, 9], [0, 0, 0]])


# --- reading ---------------------------------------------------------------------------------------------------------


def test_a_real_gopro_s_positions_are_read(shared_data):
    found = positions_in_video(shared_data / "gopro" / "max-heromode.mp4")
    assert len(found.latitude_deg) == 191  # at 18 Hz
    assert found.latitude_deg[0] == pytest.approx(0x13BEBE74 / 1e7) and found.longitude_deg[0] < -117.3
    assert found.t_ns is not None and 17.5 < 190 / ((found.t_ns[-1] - found.t_ns[0]) * 1e-9) < 18.5
    with pytest.raises(FormatError, match="no positions"):
        positions_in_video(shared_data / "gopro" / "karma.mp4")


def test_gopro_positions_without_a_fix_are_left_out(subtests, tmp_path_factory):
    imu = recorded(200.0, 200.0)
    for key in (b"GPS5", b"GPS9"):
        with subtests.test(key=key):
            tmp_path = tmp_path_factory.mktemp("given")
            t_s = np.arange(float(imu.gyro_t_s[0]), float(imu.gyro_t_s[-1]), 0.1)
            place = np.stack([48 + 1e-5 * t_s, -11 - 1e-5 * t_s, 500 + t_s], axis=1)
            found = positions_in_video(imu_files.write_gopro(tmp_path / "a.mp4", imu, gps=(key, t_s, place, 2)))
            gone = (t_s >= t_s[0] + 2.002) & (t_s < t_s[0] + 3.003)
            assert len(found.latitude_deg) == np.sum(~gone)
            np.testing.assert_allclose(found.latitude_deg, place[~gone, 0], atol=1e-7)
            np.testing.assert_allclose(found.longitude_deg, place[~gone, 1], atol=1e-7)
            np.testing.assert_allclose(found.height_m, place[~gone, 2], atol=1e-3)
            np.testing.assert_allclose(found.sigma_m, 1.4 * 1.5)
            assert found.height_above == ("sea" if key == b"GPS5" else "unknown")


def test_camm_positions_are_read(tmp_path):
    imu = recorded(200.0, 200.0)
    fixes = np.stack([np.arange(5.0) / 4, 10 + np.arange(5), -20 - np.arange(5), np.full(5, 77.0)], axis=1)
    found = positions_in_video(imu_files.write_camm(tmp_path / "a.mp4", imu, fixes=fixes))
    np.testing.assert_allclose(found.latitude_deg, fixes[:, 1])
    np.testing.assert_allclose(found.longitude_deg, fixes[:, 2])
    np.testing.assert_allclose(found.sigma_m, 2.5)
    assert found.t_ns is not None
    np.testing.assert_allclose(np.diff(found.t_ns), 0.25e9, atol=2e3)
    with pytest.raises(FormatError, match="no positions"):
        positions_in_video(imu_files.write_camm(tmp_path / "b.mp4", imu))
    # an endless error is one that is not known
    stated, endless = (struct.pack("<ff", sigma, 4.0) for sigma in (2.5, np.inf))
    (tmp_path / "a.mp4").write_bytes((tmp_path / "a.mp4").read_bytes().replace(stated, endless))
    assert np.isnan(positions_in_video(tmp_path / "a.mp4").sigma_m).all()


def with_position(path, latitude, longitude, height, *, below=False):
    """A picture whose EXIF Pillow writes."""
    from PIL import ExifTags, Image

    def sexagesimal(angle):
        angle = abs(angle)
        degrees, minutes = int(angle), int(angle % 1 * 60)
        return (degrees, minutes, (angle - degrees - minutes / 60) * 3600)

    with Image.open(path) as picture:
        exif = picture.getexif()
        exif[ExifTags.IFD.GPSInfo] = {
            1: "N" if latitude >= 0 else "S",
            2: sexagesimal(latitude),
            3: "E" if longitude >= 0 else "W",
            4: sexagesimal(longitude),
            5: b"\1" if below else b"\0",
            6: abs(height),
        }
        picture.load()
        picture.save(path, exif=exif, quality=95)


def test_positions_of_pictures_are_read(tmp_path):
    from PIL import Image

    for name in ("a.jpg", "b.jpg", "c.png", "d.jpg"):
        Image.new("L", (8, 8)).save(tmp_path / name)
    with_position(tmp_path / "a.jpg", 48.137222, 11.575556, 519.5)
    with_position(tmp_path / "b.jpg", -33.9258, -70.5, 4.0, below=True)
    with_position(tmp_path / "c.png", 0.25, 179.5, 0.0)
    found = positions_in_pictures(tmp_path, ["a.jpg", "b.jpg", "c.png", "d.jpg"])
    assert found.names == ("a.jpg", "b.jpg", "c.png")
    np.testing.assert_allclose(found.latitude_deg, [48.137222, -33.9258, 0.25], atol=1e-7)
    np.testing.assert_allclose(found.longitude_deg, [11.575556, -70.5, 179.5], atol=1e-7)
    np.testing.assert_allclose(found.height_m, [519.5, -4, 0], atol=1e-6)
    assert "3 of 4" in found.source
    with pytest.raises(FormatError, match="none of its 1 images"):
        positions_in_pictures(tmp_path, ["d.jpg"])


# --- a project -------------------------------------------------------------------------------------------------------

ORIGIN, HEADING_RAD = (48.15, 11.57, 500.0), 0.7


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """A project whose pictures have positions to a few centimetres: the folder, the result, the true path (ENU)."""
    root = tmp_path_factory.mktemp("placed")
    box = build(root / "box", every=10)
    shutil.copytree(box.root, root / "project")
    true = box.recording.truth.motion.cam_in_world_m(box.recording.trajectory.t_s[list(box.frames)])
    enu = true @ turn(HEADING_RAD).T
    noisy = enu + 0.03 * np.random.default_rng(1).standard_normal(enu.shape)
    for name, place in zip(box.names, geodetic_of_enu(noisy, ORIGIN), strict=True):
        with_position(root / "project" / "images" / name, *place)
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    options = ReconstructOptions(georeference=True, refine="off")
    return box, root, reconstruct_project(root / "project", root / "out", source, options), enu


def test_a_project_stands_where_its_pictures_were_taken(placed, tmp_path):
    box, root, result, enu = placed
    (model,) = result.models
    found = model.georeference
    assert isinstance(found, Georeference)
    assert 2 * found.heading_sigma_deg < 10
    reconstruction = read_model(root / "out" / "sparse" / "0")
    centres = {image.name: image.projection_center() for image in reconstruction.images.values()}
    written = json.loads((root / "out" / "georeference.json").read_text())["models"][0]
    assert json.loads((root / "out" / "result.json").read_text())["models"][0]["georeference"] == found.as_json()
    there = geodetic_of_enu(enu, ORIGIN)
    for camera in written["cameras"]:
        true = there[box.names.index(camera["name"])]
        assert camera["latitude_deg"] == pytest.approx(true[0], abs=0.15 / 111e3)
        assert camera["longitude_deg"] == pytest.approx(true[1], abs=0.15 / 74e3)
        assert camera["height_m"] == pytest.approx(true[2], abs=0.2)
        np.testing.assert_allclose(
            found.geodetic(centres[camera["name"]][None])[0], [camera[k] for k in list(camera)[1:]], rtol=1e-12
        )
    # without being asked, nothing of it stays
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    out = shutil.copytree(root / "out", tmp_path / "out")
    again = reconstruct_project(root / "project", out, source, ReconstructOptions(refine="off"), overwrite=True)
    assert again.models[0].georeference is None and not (out / "georeference.json").exists()


def test_exports_are_on_the_map(placed, tmp_path):
    pyproj, laspy = (pytest.importorskip(name, reason="the extra las is not installed") for name in ("pyproj", "laspy"))
    _, root, result, _ = placed
    found = result.models[0].georeference
    made = export_model(root / "out", tmp_path / "csv", "csv", georeference=True)
    rows = list(csv.DictReader((tmp_path / "csv" / "cameras.csv").read_text().splitlines()))
    centres = np.array([[float(row[k]) for k in "xyz"] for row in rows])
    place = np.array([[float(row[k]) for k in ("latitude_deg", "longitude_deg", "height_m")] for row in rows])
    np.testing.assert_allclose(found.geodetic(centres), place, atol=2e-7)
    assert len(json.loads((tmp_path / "csv" / "georeference.json").read_text())["cameras"]) == made.images
    export_model(root / "out", tmp_path / "las", "las", georeference=True)
    las = laspy.read(tmp_path / "las" / "points.las")
    assert las.header.parse_crs().to_epsg() == 32632  # 48 degrees north, 11 degrees east
    reconstruction = read_model(root / "out" / "sparse" / "0")
    xyz = np.array([reconstruction.points3D[i].xyz for i in sorted(reconstruction.points3D)])
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, height = geodetic.transform(*found.ecef_m(xyz).T)
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    np.testing.assert_allclose(las.xyz, np.stack([*to_utm.transform(lon, lat), height], axis=1), atol=0.01)
    plain = export_model(root / "out", tmp_path / "plain", "csv")
    assert "latitude_deg" not in (plain.folder / "cameras.csv").read_text()


def test_without_positions_it_is_said_before_the_work(placed, tmp_path):
    box = placed[0]
    source = ProjectOptions(imu=box.imu, frame_times=box.frame_times)
    with pytest.raises(FormatError, match="nothing to georeference by"):
        reconstruct_project(box.root, tmp_path / "out", source, ReconstructOptions(georeference=True))
    assert not (tmp_path / "out" / "result.json").exists()


def test_the_report_says_where_it_is(placed):
    _, root, result, _ = placed
    found = result.models[0].georeference
    page = (root / "out" / "report.html").read_text()
    assert f"{found.latitude_deg:.6f}, {found.longitude_deg:.6f}°" in page
    assert f"{found.used} positions" in page
    assert "lag of positions" in page and found.delay_sigma_s < 0.31
