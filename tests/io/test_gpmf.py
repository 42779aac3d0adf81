"""Streams of GoPro's telemetry, entry by entry, and the times of their samples."""

import struct
from pathlib import Path

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.gpmf import read_streams, spread


def entry(key, kind, form, *rows):
    """Rows of one entry, padded to four bytes."""
    data = b"".join(struct.pack(f">{form}", *row) for row in rows)
    return struct.pack(">4scBH", key, kind, struct.calcsize(f">{form}"), len(rows)) + data + bytes(-len(data) % 4)


def nested(key, *inside):
    data = b"".join(inside)
    return struct.pack(">4scBH", key, b"\0", 1, len(data)) + data + bytes(-len(data) % 4)


def stream(*inside):
    return nested(b"STRM", *inside)


def device(*streams, number=1, name=b"Camera", tick=None):
    known = [entry(b"DVID", b"L", "I", (number,)), entry(b"DVNM", b"c", f"{len(name)}s", (name,))]
    known += [] if tick is None else [entry(b"TICK", b"L", "I", (tick,))]
    return nested(b"DEVC", *known, *streams)


def gyro(*rows, key=b"GYRO"):
    return entry(key, b"s", "3h", *rows)


def read(*payloads, wanted=("GYRO",)):
    return read_streams(Path("film.mp4"), list(payloads), [100 * k for k in range(len(payloads))], set(wanted))


def test_samples_are_scaled_stamped_and_kept_apart_by_device():
    scale, stamp = entry(b"SCAL", b"s", "h", (100,)), [entry(b"STMP", b"J", "Q", (1000 * k,)) for k in (5, 6)]
    each = entry(b"SCAL", b"s", "h", (1,), (10,), (100,))
    found = read(
        device(stream(stamp[0], scale, gyro((100, 200, 300), (400, 500, 600))))
        + device(stream(each, gyro((7, 7, 7))), number=2),
        device(stream(stamp[1], scale, gyro((1, 2, 3)))),
    )
    first, second = found
    assert first.values.tolist() == [[1, 2, 3], [4, 5, 6], [0.01, 0.02, 0.03]]
    assert first.payload == [0, 1] and first.count.tolist() == [2, 1] and first.device == "Camera"
    stamps, kind = first.stamps(np.array([0, 10**9]))
    assert kind == "STMP" and stamps.tolist() == [5_000_000, 6_000_000]
    assert second.values.tolist() == [[7, 0.7, 0.07]] and second.payload == [0]
    # of its own clock there is nothing: the track's
    stamps, kind = second.stamps(np.array([3, 4]))
    assert kind == "track" and stamps.tolist() == [3]


def test_a_device_s_tick_and_a_delay_time_its_streams():
    late = entry(b"TIMO", b"f", "f", (0.25,))
    payloads = [device(stream(late, gyro(*[(k, k, k)] * 10)), tick=1000 * k) for k in range(1, 5)]
    (found,) = read(*payloads)
    stamps, kind = found.stamps(np.zeros(4, dtype=np.int64))
    assert kind == "TICK" and stamps.tolist() == [10**9 * k for k in range(1, 5)]
    assert found.sample_times_ns(np.zeros(4, dtype=np.int64)) == pytest.approx(
        1e9 + 1e8 * np.arange(40) - 0.25e9, abs=2
    )
    assert found.text("SIUN") == ""


def test_the_first_of_two_streams_of_a_kind_counts_and_empty_ones_do_not():
    (found,) = read(
        device(stream(gyro((1, 1, 1))), stream(gyro((2, 2, 2)))), device(stream(gyro()), stream(gyro((3, 3, 3))))
    )
    assert found.values[:, 0].tolist() == [1, 3]
    heat = device(stream(entry(b"TMPC", b"s", "h", (20,))), stream(entry(b"TMPC", b"f", "f", (21.5,))))
    (found,) = read(heat, wanted=("TMPC",))
    assert found.values.tolist() == [[21.5]]
    mixed = entry(b"GPS9", b"?", "iH", (-70_000, 5)), entry(b"TYPE", b"c", "2s", (b"lS",))
    (found,) = read(device(stream(mixed[1], entry(b"SCAL", b"l", "i", (10,), (1,)), mixed[0])), wanted=("GPS9",))
    assert found.values.tolist() == [[-7000, 5]]


def test_streams_that_contradict_themselves_are_named(subtests):
    for payloads, said in (
        (
            [device(stream(entry(b"SCAL", b"s", "h", (1,), (2,)), gyro((1, 2, 3))))],
            r"GYRO has 3 channels and the scale \[1",
        ),
        ([device(stream(entry(b"SCAL", b"s", "h", (0,)), gyro((1, 2, 3))))], r"the scale \[0"),
        ([device(stream(entry(b"SCAL", b"f", "f", (np.nan,)), gyro((1, 2, 3))))], r"the scale \[nan"),
        (
            [device(stream(gyro((1, 2, 3)))), device(stream(entry(b"GYRO", b"s", "2h", (1, 2))))],
            "payload 2 at byte 100: GYRO changes from 3 to 2 channels",
        ),
        ([device(stream(entry(b"GYRO", b"x", "3h", (1, 2, 3))))], "payload 1 at byte 0: GYRO holds samples of 6 bytes"),
        (
            [device(stream(gyro((1, 2, 3))))[:-4]],
            "payload 1 at byte 0: the entry b'DEVC' at byte 0 of the payload states",
        ),
    ):
        with subtests.test(said=said), pytest.raises(FormatError, match=said):
            read(*payloads)


def test_samples_lie_evenly_but_where_some_were_lost_or_came_from_before():
    count = np.full(12, 10)
    even_ns = 5 + 1_000_000 * np.arange(12)
    assert spread(even_ns, count, 2, 0.02) == pytest.approx(5 + 100_000 * np.arange(120), abs=1)
    # after a loss, time goes on where the stamp says
    lost_ns = even_ns + np.where(np.arange(12) > 5, 70_000, 0)
    found = spread(lost_ns, count, 2, 0.02)
    assert found[:60] == pytest.approx(5 + 100_000 * np.arange(60), abs=1)
    assert found[60:] == pytest.approx(5 + 70_000 + 100_000 * np.arange(60, 120), abs=1)
    # up to the share, a late stamp is smoothed
    late_ns = even_ns + np.where(np.arange(12) == 6, 19_000, 0)
    assert np.abs(np.diff(spread(late_ns, count, 2, 0.02)) - 100_000).max() < 1_000
    # a first payload of twice the samples in the usual time
    many = np.r_[20, count[1:]]
    found = spread(even_ns, many, 2, 0.02)
    assert np.diff(found) == pytest.approx(np.full(129, 100_000), abs=1) and found[20] == pytest.approx(
        even_ns[1], abs=1
    )


def test_stamps_without_a_pace_are_refused(subtests):
    for stamps_ns, said in (([5], "single payload"), ([5, 5, 5], "do not increase"), ([9, 5, 1], "do not increase")):
        with subtests.test(stamps_ns=stamps_ns, said=said), pytest.raises(ValueError, match=said):
            spread(np.array(stamps_ns), np.full(len(stamps_ns), 4), 2, 0.02)
