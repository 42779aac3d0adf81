"""The index of an MP4 file, box by box: each sample where it is and when, and each kind of damage by its own words."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.mp4 import is_mp4, read_movie


def box(name, *content):
    inside = b"".join(content)
    return struct.pack(">I4s", 8 + len(inside), name) + inside


def table(name, form, rows, *, count=None):
    packed = b"".join(struct.pack(f">{form}", *row) for row in rows)
    return box(name, struct.pack(">II", 0, len(rows) if count is None else count), packed)


SIZES = [3, 5, 2, 4]
PARTS = {
    "mvhd": box(b"mvhd", bytes(12), struct.pack(">II", 1000, 0), bytes(80)),
    "mdhd": box(b"mdhd", bytes(12), struct.pack(">II", 90_000, 0), bytes(4)),
    "hdlr": box(b"hdlr", bytes(8), b"vide", bytes(12)),
    "stsd": box(
        b"stsd", bytes(8), struct.pack(">I4s", 86, b"avc1"), bytes(24), struct.pack(">HH", 640, 480), bytes(50)
    ),
    "stsz": box(b"stsz", struct.pack(">III", 0, 0, 4), struct.pack(">4I", *SIZES)),
    "stts": table(b"stts", "II", [(3, 3000), (1, 9000)]),
    "ctts": table(b"ctts", "Ii", [(2, 6000), (2, 0)]),
    "stsc": table(b"stsc", "III", [(1, 3, 1), (2, 1, 1)]),
    # after a box of eight bytes
    "stco": table(b"stco", "I", [(16,), (40,)]),
    "edts": box(b"edts", table(b"elst", "ii4x", [(500, -1), (9000, 3000)])),
    "udta": box(b"udta", box(b"name", b"film"), bytes(4)),
}


def write_movie(path, *, length=60, **changed):
    """A file with two chunks of one track, and its index behind them."""
    part = {**PARTS, **changed}
    lists = box(b"stbl", *(part[name] for name in ("stsd", "stsz", "stts", "ctts", "stsc", "stco")))
    media = box(b"mdia", part["mdhd"], part["hdlr"], box(b"minf", lists))
    index = box(b"moov", part["mvhd"], box(b"trak", part["edts"], media), part["udta"])
    data = struct.pack(">I4s", 8, b"free") + struct.pack(">I4s", length - 8, b"mdat") + bytes(range(length - 16))
    path.write_bytes(data + index)
    return path


def test_samples_lie_in_their_chunks_and_are_shown_when_the_lists_say(tmp_path):
    path = write_movie(tmp_path / "a.mp4")
    movie = read_movie(path)
    (track,) = movie.tracks
    assert is_mp4(path) and (track.handler, track.entry, track.width_px, track.height_px) == ("vide", "avc1", 640, 480)
    assert track.size.tolist() == SIZES and track.offset.tolist() == [16, 19, 24, 40]
    # half a second late, from a thirtieth on
    shown = np.array([0 + 6000, 3000 + 6000, 6000, 9000]) - 3000 + 45_000
    assert track.t_ns == pytest.approx(shown * 1e9 / 90_000, abs=1)
    assert movie.samples(track) == [bytes(range(0, 3)), bytes(range(3, 8)), bytes([8, 9]), bytes(range(24, 28))]
    assert movie.user_data == {"name": b"film"}
    assert movie.track(handler="meta") is None and movie.track(entry="avc1") is track
    with pytest.raises(FormatError, match="holds no telemetry"):
        movie.telemetry("gpmd", "telemetry")
    long = table(b"co64", "q", [(16,), (40,)])
    same = box(b"stsz", struct.pack(">III", 0, 3, 4))
    (track,) = read_movie(write_movie(path, stco=long, stsz=same)).tracks
    assert track.offset.tolist() == [16, 19, 22, 40] and track.size.tolist() == [3] * 4
    assert read_movie(write_movie(path, hdlr=box(b"hdlr", bytes(8), b"soun", bytes(12)))).tracks == ()


def test_damage_of_the_index_is_named(subtests, tmp_path_factory):
    for changed, said in (
        ({"mdhd": box(b"mdhd", bytes(12), struct.pack(">II", 0, 0), bytes(4))}, "a timescale of 0"),
        ({"mdhd": box(b"mdhd", bytes(20))}, r"a header is cut off \(20 bytes, 24 needed\)"),
        ({"hdlr": box(b"hdlr", bytes(8))}, r"a handler is cut off"),
        ({"stsd": box(b"stsd", bytes(12))}, "stsd is cut off"),
        ({"stsz": box(b"stsz", bytes(8))}, "stsz is cut off"),
        ({"stsz": box(b"stsz", struct.pack(">III", 0, 0, 5), bytes(16))}, "stsz with 5 rows is cut off"),
        ({"stsz": box(b"stsz", struct.pack(">III", 0, 1000, 4))}, "4 samples of 1000 bytes, more than the file holds"),
        ({"stts": table(b"stts", "II", [(3, 3000)])}, "stts lists 3 samples where stsz lists 4"),
        ({"stts": table(b"stts", "II", [(4, 1)], count=2)}, "stts with 2 rows is cut off"),
        ({"ctts": table(b"ctts", "Ii", [(5, 0)])}, "ctts lists 5 samples where stsz lists 4"),
        ({"stsc": table(b"stsc", "III", [(2, 4, 1)])}, "stsc does not list its chunks in order"),
        ({"stsc": table(b"stsc", "III", [(1, 3, 1), (4, 1, 1)])}, "stsc does not list its chunks in order"),
        ({"stsc": table(b"stsc", "III", [])}, "stsc does not list its chunks in order"),
        ({"stsc": table(b"stsc", "III", [(1, 3, 1)])}, "chunks hold 6 samples where stsz lists 4"),
        ({"edts": box(b"edts", table(b"elst", "ii4x", [(0, 0)], count=3))}, "elst with 3 rows is cut off"),
        ({"edts": box(b"edts", box(b"elst", bytes(4)))}, "elst is cut off"),
        ({"udta": struct.pack(">I4s", 7, b"udta")}, "the box 'udta' states a size of 7 bytes"),
        ({"udta": struct.pack(">I4s", 99, b"udta")}, "the box 'udta' states a size of 99 bytes where 8 are left"),
    ):
        with subtests.test(changed=changed, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            with pytest.raises(FormatError, match=said):
                read_movie(write_movie(tmp_path / "a.mp4", **changed))


def test_samples_beyond_the_file_or_over_each_other_are_refused(tmp_path):
    movie = read_movie(write_movie(tmp_path / "a.mp4"))
    (track,) = movie.tracks
    length = movie.path.stat().st_size
    last = replace(track, offset=np.array([16, 19, 24, length - 4]))
    assert len(movie.samples(last)) == 4 and movie.beyond(last).tolist() == []
    for offset, wrong in ((length - 3, "sample 4"), (-1, "sample 4")):
        with pytest.raises(FormatError, match=f"{wrong} of the avc1 track at byte {offset} ends beyond"):
            movie.samples(replace(track, offset=np.array([16, 19, 24, offset])))
    whole = replace(track, offset=np.zeros(4, dtype=np.int64), size=np.full(4, length // 4 + 1))
    with pytest.raises(FormatError, match="samples of the avc1 track overlap"):
        movie.samples(whole)


def test_frames_are_in_order_and_none_shown_with_another(tmp_path):
    path = tmp_path / "a.mp4"
    none = table(b"ctts", "Ii", [(4, 0)])
    movie = read_movie(write_movie(path, edts=b"", ctts=none))
    assert movie.frame_times_ns() == pytest.approx(np.array([0, 3000, 6000, 9000]) * 1e9 / 90_000, abs=1)
    back = table(b"ctts", "Ii", [(1, 0), (1, 6000), (1, 0), (1, -6000)])
    assert read_movie(write_movie(path, edts=b"", ctts=back)).frame_times_ns()[1] == pytest.approx(3e9 / 90, abs=1)
    twice = table(b"ctts", "Ii", [(1, 3000), (3, 0)])
    with pytest.raises(FormatError, match="two samples of its avc1 track have the same time"):
        read_movie(write_movie(path, ctts=twice)).frame_times_ns()
    with pytest.raises(FormatError, match="holds no video"):
        read_movie(write_movie(path, hdlr=box(b"hdlr", bytes(8), b"meta", bytes(12)))).frame_times_ns()


def test_a_file_without_a_whole_index_is_refused(subtests, tmp_path_factory):
    for content, said in (
        (b"", "holds no index"),
        (box(b"ftyp", b"isom") + box(b"mdat", bytes(9)), "holds no index"),
        (
            box(b"ftyp", b"isom") + struct.pack(">I4s", 7, b"free") + bytes(20),
            "the box 'free' at byte 12 states a size of 7",
        ),
        (struct.pack(">I4s", 100, b"moov") + bytes(40), "its index at byte 0 ends beyond the file's 48 bytes"),
        (struct.pack(">I4sQ", 1, b"moov", 9) + bytes(40), "the box 'moov' at byte 0 states a size of 9"),
        (struct.pack(">I4sQ", 1, b"moov", 1 << 40) + bytes(40), "its index at byte 0 ends beyond"),
        (struct.pack(">I4s", 1, b"moov") + bytes(4), "the box 'moov' at byte 0 states a size of 0"),
    ):
        with subtests.test(content=content, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            path = tmp_path / "a.mp4"
            path.write_bytes(content)
            with pytest.raises(FormatError, match=said):
                read_movie(path)
