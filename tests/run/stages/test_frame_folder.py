"""Pictures come out as they went in: coding, colours, alpha and metadata, as Pillow reads them."""

import io
import struct

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, JpegImagePlugin, TiffImagePlugin

from colmap_inertial.core.errors import FormatError, TimingError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.exif import exposure_of, position_of, stamps_of_exif
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.jpeg_coding import read_jpeg_coding
from colmap_inertial.run.stages.frame_folder import encode_image


def picture(dtype=np.uint8, channels=3):
    rng = np.random.default_rng(1)
    coarse = cv2.resize(rng.random((6, 8, channels)), (160, 120), interpolation=cv2.INTER_CUBIC)
    return np.clip(coarse.reshape(120, 160, channels) * np.iinfo(dtype).max, 0, np.iinfo(dtype).max).astype(dtype)


def test_a_jpeg_keeps_quality_and_sampling(subtests, tmp_path_factory):
    for subsampling in (0, 1, 2):
        for quality in (85, 90, 95, 98):
            with subtests.test(subsampling=subsampling, quality=quality):
                tmp_path = tmp_path_factory.mktemp("given")
                Image.fromarray(picture()).save(tmp_path / "a.jpg", quality=quality, subsampling=subsampling)
                encode_image(tmp_path / "b.jpg", picture(), tmp_path / "a.jpg")
                with Image.open(tmp_path / "a.jpg") as before, Image.open(tmp_path / "b.jpg") as after:
                    assert JpegImagePlugin.get_sampling(after) == JpegImagePlugin.get_sampling(before) == subsampling
                    assert after.quantization[0] == before.quantization[0]


def test_a_coarse_or_grey_jpeg_is_written_within_limits(tmp_path):
    for quality, expected in ((30, 85), (100, 98)):
        Image.fromarray(picture()).save(tmp_path / "a.jpg", quality=quality)
        assert read_jpeg_coding((tmp_path / "a.jpg").read_bytes())[0] == expected
    Image.fromarray(picture(channels=1)[..., 0]).save(tmp_path / "grey.jpg", quality=91)
    assert read_jpeg_coding((tmp_path / "grey.jpg").read_bytes()) == (91, None)
    encode_image(tmp_path / "out.jpg", picture(channels=1)[..., 0], tmp_path / "grey.jpg")
    with Image.open(tmp_path / "out.jpg") as made:
        assert made.mode == "L"


def test_a_tiff_keeps_its_profile_device_date_and_exif(tmp_path):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[271], tags[272], tags[306] = "Maker", "A model with a long name", "2026:11:24 10:00:00"
    tags[34665] = {33434: TiffImagePlugin.IFDRational(1, 60), 34855: 800, 36867: "2026:11:24 10:00:00"}
    tags[34853] = {1: "N", 2: tuple(TiffImagePlugin.IFDRational(n, 1) for n in (48, 8, 30))}
    data = io.BytesIO()
    with Image.fromarray(picture()) as image:
        image.encoderinfo = {}
        image.save(data, format="TIFF", tiffinfo=tags, icc_profile=profile)
    (tmp_path / "a.tif").write_bytes(data.getvalue())
    made = 255 - picture()
    encode_image(tmp_path / "b.tif", made, tmp_path / "a.tif")
    with Image.open(tmp_path / "a.tif") as before, Image.open(tmp_path / "b.tif") as after:
        np.testing.assert_array_equal(np.asarray(after), made)
        assert after.info["icc_profile"] == profile
        for tag in (271, 272, 306):
            assert after.tag_v2[tag] == before.tag_v2[tag] == tags[tag]
        for directory in (34665, 34853):
            assert dict(after.getexif().get_ifd(directory)) == dict(before.getexif().get_ifd(directory)) != {}
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b.tif"), cv2.IMREAD_UNCHANGED)[..., ::-1], made)


def test_a_tiff_of_the_other_order_of_bytes_keeps_its_values(tmp_path):
    text, exposure = b"A model with a long name\0", (1, 60)
    # header, one directory of model and EXIF, the EXIF's with ExposureTime, ISO and width, in big-endian order
    head = b"MM\0*" + (8).to_bytes(4, "big")
    first = (2).to_bytes(2, "big") + _entry(272, 2, len(text), 38) + _entry(34665, 4, 1, 64) + bytes(4)
    inner = (3).to_bytes(2, "big") + _entry(33434, 5, 1, 106) + _entry(34855, 3, 1, 800 << 16)
    inner += _entry(40962, 4, 1, 640) + bytes(4)
    values = b"".join(n.to_bytes(4, "big") for n in exposure)
    original = head + first + text.ljust(26, b"\0") + inner + values
    assert len(head + first) == 38 and original.index(inner) == 64 and original.index(values, 90) == 106
    (tmp_path / "a.tif").write_bytes(original)
    encode_image(tmp_path / "b.tif", picture(np.uint16), tmp_path / "a.tif")
    with Image.open(tmp_path / "b.tif") as made:
        assert made.tag_v2[272] == "A model with a long name"
        exif = made.getexif().get_ifd(34665)
        assert float(exif[33434]) == pytest.approx(1 / 60) and (exif[34855], exif[40962]) == (800, 640)


def _entry(tag, kind, count, value):
    return b"".join(n.to_bytes(size, "big") for n, size in ((tag, 2), (kind, 2), (count, 4), (value, 4)))


def test_alpha_stays_where_pixels_do(subtests, tmp_path_factory):
    for ending in (".png", ".tif"):
        for dtype in (np.uint8, np.uint16):
            with subtests.test(ending=ending, dtype=dtype):
                tmp_path = tmp_path_factory.mktemp("given")
                before = picture(dtype, 4)
                cv2.imwrite(str(tmp_path / f"a{ending}"), before)
                for moved in (False, True):
                    encode_image(tmp_path / f"b{ending}", before[..., 2::-1] // 2, tmp_path / f"a{ending}", moved=moved)
                    made = cv2.imread(str(tmp_path / f"b{ending}"), cv2.IMREAD_UNCHANGED)
                    np.testing.assert_array_equal(made[..., :3], before[..., :3] // 2)
                    assert made.shape[2] == (3 if moved else 4)
                    if not moved:
                        np.testing.assert_array_equal(made[..., 3], before[..., 3])


def test_a_webp_that_has_a_time_is_named(tmp_path):
    (tmp_path / "frames").mkdir()
    Image.fromarray(picture()).save(tmp_path / "frames" / "a.png")
    Image.fromarray(picture()).save(tmp_path / "frames" / "b.webp")
    (tmp_path / "frames.csv").write_text("name,t_s\na.png,0.0\nb.webp,0.1\nmissing.png,0.2\n")
    (tmp_path / "capture.toml").write_text('[images]\nfolder = "frames"\ntimes = "frames.csv"\n')
    with pytest.raises(FormatError, match=r"b\.webp.*convert them"):
        read_frame_timing(load_capture(tmp_path / "capture.toml"))


# --- EXIF, byte by byte ----------------------------------------------------------------------------------------------

ASCII, SHORT, LONG, RATIONAL = 2, 3, 4, 5


def tiff_with(order, pointer, entries):
    """A TIFF structure of two directories: one that points to the other, and that of entries: tag, type, values."""
    marks = {"<": b"II*\0", ">": b"MM\0*"}
    head = marks[order] + struct.pack(order + "I", 8)
    first = struct.pack(order + "HHHII", 1, pointer, LONG, 1, 26) + bytes(4)
    at, rows, data = 26 + 2 + 12 * len(entries) + 4, b"", b""
    for tag, kind, values in entries:
        raw = values if kind == ASCII else struct.pack(f"{order}{len(values)}{'H' if kind == SHORT else 'I'}", *values)
        count = len(values) // 2 if kind == RATIONAL else len(values)
        if len(raw) > 4:
            raw, data = struct.pack(order + "I", at + len(data)), data + raw
        rows += struct.pack(order + "HHI4s", tag, kind, count, raw.ljust(4, b"\0"))
    return head + first + struct.pack(order + "H", len(entries)) + rows + bytes(4) + data


def place_of(order="<", **changed):
    """The position by EXIF that says 48 degrees, 7.5 minutes and 36 seconds north, 11 and a half east, 520.25 m."""
    said = {
        "north": (1, ASCII, b"N\0"),
        "latitude": (2, RATIONAL, (48, 1, 75, 10, 3600, 100)),
        "east": (3, ASCII, b"E\0"),
        "longitude": (4, RATIONAL, (23, 2, 0, 1, 0, 7)),
        "side": (5, ASCII, b"\0"),
        "height": (6, RATIONAL, (2081, 4)),
        "error": (31, RATIONAL, (35, 10)),
    }
    said |= {name: None if value is None else (*said[name][:2], value) for name, value in changed.items()}
    return position_of(tiff_with(order, 0x8825, [entry for entry in said.values() if entry is not None]))


def test_a_place_is_what_its_fractions_say(subtests):
    for order in ("<", ">"):
        with subtests.test(order=order):
            assert place_of(order) == (pytest.approx(48.135), pytest.approx(11.5), 520.25, 3.5, "sea")
            assert place_of(order, north=b"S\0")[0] == pytest.approx(-48.135)
            assert place_of(order, east=b"w\0")[1] == pytest.approx(-11.5)
            for side, height_m, above in ((1, -520.25, "sea"), (2, 520.25, "ellipsoid"), (3, -520.25, "ellipsoid")):
                assert place_of(order, side=bytes([side]))[2::2] == (height_m, above)
            assert np.isnan(place_of(order, height=None)[2]) and np.isnan(place_of(order, error=(0, 1))[3])
            assert place_of(order, side=None)[2:] == (520.25, 3.5, "sea")
            assert place_of(order, latitude=(90, 1, 0, 1, 0, 1), longitude=(180, 1, 0, 1, 0, 1))[:2] == (90, 180)


def test_what_is_no_place_is_none(subtests):
    for wrong in (
        {"north": b"E\0"},
        {"north": None},
        {"east": b"N\0"},
        {"latitude": (90, 1, 1, 1, 0, 1)},
        {"longitude": (180, 1, 0, 1, 1, 1)},
        {"latitude": (48, 1, 0, 0, 0, 1)},
        {"latitude": (48, 1, 0, 1)},
        {"height": (520, 0)},
        {"error": (3, 1, 4, 1)},
    ):
        with subtests.test(wrong=wrong):
            assert place_of(**wrong) is None


@pytest.mark.parametrize("order", ["<", ">"])
def test_exposure_and_sensitivity_are_what_exif_says(order):
    def said(*entries):
        return exposure_of(tiff_with(order, 0x8769, entries))

    time, iso = (0x829A, RATIONAL, (1, 250)), (0x8827, SHORT, (400,))
    assert said(time, iso) == (0.004, 400) and said(time) == (0.004, None) and said(iso) == (None, 400)
    assert said((0x829A, RATIONAL, (99, 10)))[0] == 9.9
    for fraction in ((10, 1), (0, 1), (1, 0)):
        assert said((0x829A, RATIONAL, fraction))[0] is None
    assert said((0x8827, SHORT, (0,)))[1] is None and said((0x8827, LONG, (400,)))[1] is None
    assert exposure_of(b"no picture") == (None, None) and position_of(b"no picture") is None


def taken(path, date=b"2024:05:01 12:30:15\0", fraction=b"2504\0", offset=b"+02:30\0", order="<"):
    """A picture that was taken then."""
    said = ((0x9003, ASCII, date), (0x9291, ASCII, fraction), (0x9011, ASCII, offset))
    path.write_bytes(tiff_with(order, 0x8769, [entry for entry in said if entry[2] is not None]))
    return path.name


def test_times_by_exif_are_universal_where_their_offset_is_stated(tmp_path):
    noon_ns = 1_714_566_615_000_000_000  # 2024-05-01 12:30:15 as universal time
    for order in "<>":
        names = [taken(tmp_path / "a.tif", order=order), taken(tmp_path / "b.tif", fraction=b"75\0", order=order)]
        stamps, digits = stamps_of_exif(tmp_path, names)
        expected = [noon_ns - 9_000_000_000_000 + ns for ns in (250_400_000, 750_000_000)]
        assert stamps.t_ns.tolist() == expected and digits == 2
    later = taken(tmp_path / "b.tif", offset=b"+00:00\0", date=b"2024:05:01 14:30:15\0")
    names = [taken(tmp_path / "a.tif", offset=b"-01:00\0"), later]
    expected = [noon_ns + 1_000_000_000 * hours * 3600 + 250_400_000 for hours in (1, 2)]
    assert stamps_of_exif(tmp_path, names)[0].t_ns.tolist() == expected
    # of the camera's own clock where none states it
    names = [taken(tmp_path / f"{k}.tif", offset=None, fraction=b"%02d\0" % k) for k in (10, 20)]
    assert stamps_of_exif(tmp_path, names)[0].t_ns.tolist() == [noon_ns + 100_000_000, noon_ns + 200_000_000]


def test_times_by_exif_that_cannot_be_compared_are_refused(subtests, tmp_path_factory):
    for wrong, error, said in (
        ({"fraction": b"5\0"}, TimingError, "b.tif: its EXIF gives the time only to tenths of a second"),
        ({"fraction": None}, TimingError, "b.tif: its EXIF gives the time only to whole seconds"),
        ({"fraction": b"2x\0"}, TimingError, "only to whole seconds"),
        ({"date": None}, FormatError, "b.tif: its EXIF has no DateTimeOriginal"),
        ({"date": b"2024-05-01 12:30:15\0"}, FormatError, "no DateTimeOriginal"),
        ({"offset": None}, TimingError, "b.tif: its EXIF does not state the offset from universal time, that of a.tif"),
    ):
        with subtests.test(wrong=wrong, error=error, said=said):
            tmp_path = tmp_path_factory.mktemp("given")
            names = [taken(tmp_path / "a.tif"), taken(tmp_path / "b.tif", **wrong)]
            with pytest.raises(error, match=said):
                stamps_of_exif(tmp_path, names)


def test_pictures_without_exif_have_no_time(tmp_path):
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    with pytest.raises(FormatError, match=r"a.png: has no EXIF to take its time from"):
        stamps_of_exif(tmp_path, ["a.png"])
    (tmp_path / "b.tif").write_bytes(tiff_with("<", 0x8769, [])[:24])
    with pytest.raises(FormatError, match=r"b.tif: its EXIF is damaged or empty"):
        stamps_of_exif(tmp_path, ["b.tif"])
    with pytest.raises(FormatError, match="no such picture"):
        stamps_of_exif(tmp_path, ["c.tif"])
