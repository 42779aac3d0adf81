"""Pictures come out as they went in: coding, colours, alpha and metadata, as Pillow reads them."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, JpegImagePlugin, TiffImagePlugin

from colmap_inertial.core.errors import FormatError
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_timing
from colmap_inertial.io.jpeg_coding import read_jpeg_coding
from colmap_inertial.pipeline.stages.frame_folder import encode_image


def picture(dtype=np.uint8, channels=3):
    rng = np.random.default_rng(1)
    coarse = cv2.resize(rng.random((6, 8, channels)), (160, 120), interpolation=cv2.INTER_CUBIC)
    return np.clip(coarse.reshape(120, 160, channels) * np.iinfo(dtype).max, 0, np.iinfo(dtype).max).astype(dtype)


@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize("quality", [85, 90, 95, 98])
def test_a_jpeg_keeps_quality_and_sampling(tmp_path, quality, subsampling):
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
    # header, one directory of model and EXIF, the EXIF's directory with ExposureTime and ISO, in big-endian order
    head = b"MM\0*" + (8).to_bytes(4, "big")
    first = (2).to_bytes(2, "big") + _entry(272, 2, len(text), 38) + _entry(34665, 4, 1, 64) + bytes(4)
    inner = (2).to_bytes(2, "big") + _entry(33434, 5, 1, 94) + _entry(34855, 3, 1, 800 << 16) + bytes(4)
    values = b"".join(n.to_bytes(4, "big") for n in exposure)
    original = head + first + text.ljust(26, b"\0") + inner + values
    assert len(head + first) == 38 and original.index(inner) == 64 and original.index(values, 90) == 94
    (tmp_path / "a.tif").write_bytes(original)
    encode_image(tmp_path / "b.tif", picture(np.uint16), tmp_path / "a.tif")
    with Image.open(tmp_path / "b.tif") as made:
        assert made.tag_v2[272] == "A model with a long name"
        exif = made.getexif().get_ifd(34665)
        assert float(exif[33434]) == pytest.approx(1 / 60) and exif[34855] == 800


def _entry(tag, kind, count, value):
    return b"".join(n.to_bytes(size, "big") for n, size in ((tag, 2), (kind, 2), (count, 4), (value, 4)))


@pytest.mark.parametrize("ending", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_stays_where_pixels_do(tmp_path, ending, dtype):
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
