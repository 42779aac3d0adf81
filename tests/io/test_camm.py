"""Packets of camera motion metadata (CAMM), byte by byte, without a video around them."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io import camm
from colmap_inertial.io.camm import _packets, read_camm_frames, read_camm_positions


def packet(kind, form, *values):
    return struct.pack("<HH", 0, kind) + struct.pack("<" + form, *values)


def turn(value):
    return packet(2, "3f", value, 2 * value, 3 * value)


def pull(value):
    return packet(3, "3f", value, 0.0, -value)


def opened(samples, step_ns=10):
    """A film with these samples in its track."""
    size = np.array([len(sample) for sample in samples], dtype=np.int64)
    track = SimpleNamespace(size=size, t_ns=step_ns * np.arange(len(samples), dtype=np.int64))
    movie = SimpleNamespace(path=Path("film.mp4"), contents=lambda _: (b"".join(samples), np.cumsum(size) - size))
    return movie, track


def test_packets_are_found_in_samples_of_one_or_several():
    direction = packet(0, "3f", 0, 0, 1)
    unknown = packet(99, "f", 1.0)
    samples = [turn(1.0), pull(2.0) + turn(3.0), direction + turn(4.0) + pull(5.0), unknown + turn(6.0), pull(7.0)]
    found = _packets(*opened(samples))
    t_ns, data = found[2]
    order = np.argsort(t_ns)
    # what stands behind a packet of no known length is not known
    assert t_ns[order].tolist() == [0, 10, 20]
    assert data[order].view("<f4").tolist() == [[1, 2, 3], [3, 6, 9], [4, 8, 12]]
    t_ns, data = found[3]
    order = np.argsort(t_ns)
    assert t_ns[order].tolist() == [10, 20, 40] and data[order].view("<f4")[:, 0].tolist() == [2, 5, 7]
    assert found[1][1].shape == (0, 8) and found[5][1].shape == (0, 24) and found[6][1].shape == (0, 56)


def test_packets_that_are_cut_off_are_named(subtests):
    for samples, said in (
        ([turn(1.0), bytes(3)], "shorter than its header"),
        ([turn(1.0), turn(2.0), pull(3.0)[:-1]], "packet 3 of type 3 of its camm track is cut off"),
        ([turn(1.0), turn(2.0) + pull(3.0)[:-4], turn(4.0)], "of type 3 of its camm track is cut off"),
    ):
        with subtests.test(said=said), pytest.raises(FormatError, match=said):
            _packets(*opened(samples))


def fix(kind=3, lat=48.0, lon=11.0, height=500.0, sigma=2.5):
    """As GPS tells it: time, kind of fix, place, accuracies, velocity and its accuracy."""
    return packet(6, "didd7f", 1e9, kind, lat, lon, height, sigma, 3.0, 0.0, 0.0, 0.0, 0.1)


def test_places_are_taken_where_there_is_a_fix_on_earth(monkeypatch):
    samples = [
        fix(), fix(kind=2), fix(kind=0), fix(lat=90.0, lon=-180.0), fix(lat=90.1), fix(lon=180.1), fix(lon=180.0),
        fix(height=np.inf), fix(lat=np.nan), fix(sigma=0.0), fix(lat=-90.0, height=-12.0),
    ]  # fmt: skip
    monkeypatch.setattr(camm, "_open_movie", lambda _: opened(samples))
    found = read_camm_positions(Path("film.mp4"))
    assert found.t_ns.tolist() == [0, 10, 30, 60, 90, 100]
    assert found.latitude_deg.tolist() == [48, 48, 90, 48, 48, -90]
    assert found.longitude_deg.tolist() == [11, 11, -180, 180, 11, 11]
    # without a height, and without an accuracy
    assert np.isnan(found.height_m).tolist() == [False, True, False, False, False, False] and found.height_m[5] == -12
    assert np.isnan(found.sigma_m).tolist() == [False] * 4 + [True, False] and found.sigma_m[0] == 2.5
    assert found.height_above == "ellipsoid"
    monkeypatch.setattr(camm, "_open_movie", lambda _: opened([fix(kind=1), turn(1.0)]))
    assert read_camm_positions(Path("film.mp4")) is None
    plain = [packet(5, "3d", 48.0, 11.0, 500.0), packet(5, "3d", 91.0, 11.0, 500.0), packet(5, "3d", 47.0, 10.0, 4.0)]
    monkeypatch.setattr(camm, "_open_movie", lambda _: opened(plain))
    found = read_camm_positions(Path("film.mp4"))
    assert found.t_ns.tolist() == [0, 20] and found.height_m.tolist() == [500, 4] and np.isnan(found.sigma_m).all()


def test_exposures_are_those_next_to_the_frames(subtests, monkeypatch):
    for exposure_ns, skew_ns, exposure_s, readout_s in (
        (4_000_000, 20_000_000, 0.004, 0.02),
        (0, 0, 0.0, 0.0),
        (-1, 20_000_000, None, 0.02),
        (4_000_000, 500_000_000, 0.004, None),
        (4_000_000, -1, 0.004, None),
    ):
        with subtests.test(exposure_ns=exposure_ns, skew_ns=skew_ns):
            samples = [packet(1, "2i", exposure_ns + (1000 * k if exposure_ns > 0 else 0), skew_ns) for k in range(5)]
            movie, track = opened(samples)
            movie.frame_times_ns = lambda: np.array([1, 19, 42], dtype=np.int64)
            monkeypatch.setattr(camm, "_open_movie", lambda _, found=(movie, track): found)
            log = read_camm_frames(Path("film.mp4"))
            if exposure_s is None:
                assert log.exposure_s is None
            else:
                extra = np.array([0, 2, 4]) * 1e-6 if exposure_ns > 0 else 0.0
                assert log.exposure_s == pytest.approx(exposure_s + extra * np.ones(3), abs=1e-12)
            assert log.readout_s == readout_s and log.in_video_time
