"""Networks that restore pictures: the same result for any size, type and number of threads; clear words otherwise."""

import ast
import json
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto, helper

from colmap_inertial.core import threads
from colmap_inertial.core.errors import FormatError, InertialError, MissingExtraError
from colmap_inertial.core.threads import usable_processors
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.path_filters import path_wiener
from colmap_inertial.imaging.restoration import (
    Network,
    _tiles,
    deepgyro,
    load_network,
    lsd2,
    network as networks,
    require_network,
    shipped,
)
from tests.helpers import small_networks as small

ROOT = Path(__file__).parents[3]
SIZES = [(1, 1), (1, 40), (5, 7), (15, 17), (16, 16), (33, 200), (120, 75)]


def ready(model, name="deepgyro", **options):
    return Network.of(model, name, source="small.onnx", device="cpu", **options)


def picture(height, width, dtype=np.uint8, channels=3, seed=0):
    """Noise of any kind of picture."""
    values = np.random.default_rng(seed).random((height, width, channels))
    values = values if channels == 3 else values[..., 0]
    return values.astype(np.float32) if dtype == np.float32 else np.rint(values * np.iinfo(dtype).max).astype(dtype)


def scene(height, width, dtype=np.uint8, channels=3):
    """Soft shapes with a little noise, as a Wiener filter takes them."""
    soft = cv2.GaussianBlur(picture(height, width, np.float32, 3, seed=4), (0, 0), 4)
    soft = np.clip(0.5 + 6 * (soft - soft.mean()) + 0.01 * (picture(height, width, np.float32) - 0.5), 0.02, 0.9)
    return np.rint(np.iinfo(dtype).max * (soft if channels == 3 else soft[..., 0])).astype(dtype)


def turning(width, height, longest_px=12.0):
    """A field of all directions, from none at one corner on."""
    rows, columns = BlurField.nodes(width, height)
    length = longest_px * np.linspace(0, 1, columns)[None] * np.linspace(0, 1, rows)[:, None]
    angle = np.linspace(0, 3, columns)[None] + np.linspace(0, 2, rows)[:, None]
    vector = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
    return BlurField(width=width, height=height, vector_px=vector.astype(np.float32))


def around(holds):
    """Where something holds for all pixels around: blur is looked at at the corners of squares of 16 px."""
    return cv2.erode(holds.astype(np.uint8), np.ones((33, 33))) == 1


# --- one picture ---------------------------------------------------------------------------------------------------


def test_any_size_and_type_comes_back_as_it_was_with_the_network_s_result(subtests):
    for size in SIZES:
        for dtype in (np.uint8, np.uint16, np.float32):
            with subtests.test(size=size, dtype=dtype):
                a, b = picture(*size, dtype), picture(*size, dtype, seed=1)
                top = 1 if dtype == np.float32 else np.iinfo(dtype).max
                true = a.astype(np.float64) / top * 0.7 + 0.3 * (b.astype(np.float64) / top)
                restored = ready(small.mixing(0.3)).restore(a, b)
                assert restored.dtype == dtype and restored.shape == a.shape
                assert np.abs(restored.astype(np.float64) / top - true).max() <= (1e-6 if top == 1 else 0.51 / top)


def test_a_grey_picture_is_seen_three_times_and_becomes_the_mean():
    a = picture(40, 50, channels=1)
    restored = ready(small.mixing(0.0, channels=(1.0, 0.5, 0.3))).restore(a, a)
    assert restored.shape == a.shape
    assert np.abs(restored - 0.6 * a.astype(np.float64)).max() < 0.51


def test_what_the_network_makes_beyond_black_and_white_is_clipped():
    white = np.full((16, 16, 3), 250, np.uint8)
    assert (ready(small.mixing(0.0, channels=(2.0, -1.0, 1.0))).restore(white, white)[3, 3] == [255, 0, 250]).all()


def test_edges_are_mirrored_to_a_multiple_of_16(subtests):
    for size in ((37, 50), (64, 70), (90, 131)):
        with subtests.test(size=size):
            a = picture(*size, np.float32)
            restored = ready(small.box()).restore(a, a)
            true = cv2.blur(a, (5, 5), borderType=cv2.BORDER_REFLECT_101)
            inside = tuple(
                slice(2, None if n % 16 else -2) for n in size
            )  # at least two pixels are put beyond the others
            np.testing.assert_allclose(restored[inside], true[inside], atol=1e-6)


def test_pictures_of_other_layouts_in_memory_are_the_same():
    a = picture(40, 60)
    network = ready(small.box())
    flipped = network.restore(a[:, ::-1], a[:, ::-1])
    np.testing.assert_array_equal(flipped, network.restore(a[:, ::-1].copy(), a[:, ::-1].copy()))
    np.testing.assert_array_equal(network.restore(np.asfortranarray(a), a), network.restore(a, a))


def test_the_network_sees_length_and_double_angle_of_the_blur():
    blur = turning(90, 70, longest_px=30)
    backwards = BlurField(width=90, height=70, vector_px=-blur.vector_px)
    a = picture(70, 90, np.float32)
    network = ready(small.seeing_blur(), "lsd2")
    seen = 2 * network.restore(a, a, blur) - 1
    np.testing.assert_allclose(2 * network.restore(a, a, backwards) - 1, seen, atol=1e-6)
    x, y = np.moveaxis(blur.at(np.arange(70) // 2 * 2 + 0.5, np.arange(90) // 2 * 2 + 0.5), -1, 0)
    length, angle = np.hypot(x, y), np.arctan2(y, x)
    true = np.stack([length * np.cos(2 * angle), length * np.sin(2 * angle), length], axis=-1) / 32
    np.testing.assert_allclose(seen, true, atol=1e-5)
    assert np.abs(true).max() > 0.7
    np.testing.assert_allclose(network.restore(a, a), 0.5, atol=1e-7)  # nothing is known


def arc(width, height, bend_px, *, reverse=False):
    """The same path everywhere: 20 px to the right, and as far up and down again as ``bend_px`` / 4."""
    s = middles(41)
    at = np.stack([20 * s, bend_px * s**2], axis=-1)[:: -1 if reverse else 1]
    nodes = BlurField.nodes(width, height, 64)
    return BlurPath(width=width, height=height, path_px=np.broadcast_to(at[:, None, None], (41, *nodes, 2)))


def test_deepgyro_sees_the_chord_of_a_path_and_to_which_side_it_is_bent():
    row, column = _tiles.tiles(70, 90)[0]
    bend = 6.0
    seen = _tiles.path_feed(arc(90, 70, bend), row, column)
    np.testing.assert_allclose(seen[0, :3, 5, 7], [20 / 32, 0, 20 / 32], atol=1e-6)
    # of q = v s + a s^2, a / 32, the same all over
    np.testing.assert_allclose(seen[0, 3:], np.broadcast_to([[[0]], [[bend / 32]]], (2, 40, 48)), atol=2e-4)
    np.testing.assert_allclose(_tiles.path_feed(arc(90, 70, bend, reverse=True), row, column), seen, atol=1e-6)
    np.testing.assert_allclose(_tiles.path_feed(arc(90, 70, -bend), row, column)[0, 4], -seen[0, 4], atol=1e-6)
    lines = turning(90, 70, longest_px=30)
    straight = _tiles.path_feed(BlurPath.straight(lines), row, column)
    np.testing.assert_allclose(straight[:, :3], _tiles.blur_feed(lines, row, column), atol=1e-5)
    np.testing.assert_allclose(straight[:, 3:], 0, atol=1e-6)


def test_deepgyro_is_told_of_paths_and_lsd2_of_lines():
    a, lines = picture(32, 32), BlurField.uniform(32, 32, (5, 0))
    with pytest.raises(ValueError, match="blur: deepgyro takes a BlurPath, not a BlurField"):
        ready(small.mixing()).restore(a, a, lines)
    with pytest.raises(ValueError, match="blur: lsd2 takes a BlurField, not a BlurPath"):
        ready(small.mixing(), "lsd2").restore(a, a, BlurPath.straight(lines))


def test_pictures_that_do_not_go_together_are_a_mistake():
    network, a = ready(small.mixing()), picture(32, 32)
    with pytest.raises(ValueError, match="image: uint8, uint16 or float32"):
        network.restore(a.astype(np.float64), a)
    with pytest.raises(ValueError, match=r"aid: of the image's shape \(32, 32, 3\)"):
        network.restore(a, a[1:])
    with pytest.raises(ValueError, match=r"image: \(H, W\) or \(H, W, 3\)"):
        network.restore(a[..., :2], a[..., :2])
    with pytest.raises(ValueError, match="blur: for 30 x 32 px, the image has 32 x 32"):
        network.restore(a, a, BlurPath.straight(BlurField.uniform(30, 32, (3, 0))))


# --- parts ---------------------------------------------------------------------------------------------------------


def test_parts_cover_every_pixel_once_with_what_lies_around(subtests):
    for seed in range(12):
        with subtests.test(seed=seed):
            rng = np.random.default_rng(seed)
            height, width = (int(n) for n in rng.integers(1, 2500, 2))
            most = int(rng.integers(400**2, 1500**2))
            kept = np.zeros((height, width), int)
            for row, column in _tiles.tiles(height, width, most):
                assert row.size * column.size <= most
                for span, size in ((row, height), (column, width)):
                    whole = -(-size // 16) * 16
                    assert span.begin % 16 == span.end % 16 == 0 and span.begin >= 0 and span.end <= whole
                    assert span.begin == 0 or span.keep_begin - span.begin >= 192
                    assert span.end == whole or span.end - span.keep_end >= 192
                (rows, _), (columns, _) = row.kept(height), column.kept(width)
                kept[rows, columns] += 1
            assert (kept == 1).all()


@pytest.mark.parametrize("size", [(1080, 1920), (1920, 1080), (3000, 4000), (6000, 8000), (12, 150_000)])
def test_a_network_never_sees_more_than_a_frame_of_full_hd(size):
    parts = [row.size * column.size for row, column in _tiles.tiles(*size)]
    assert max(parts) <= 1920 * 1088
    assert sum(parts) < 1.75 * np.prod([-(-n // 16) * 16 for n in size])
    assert (len(parts) == 1) == (min(size) == 1080)


def test_parts_do_not_show(subtests):
    for size in ((500, 700), (613, 531)):
        for model in (small.coarse, small.box):
            with subtests.test(size=size, model=model), pytest.MonkeyPatch.context() as monkeypatch:
                assert 182 < small.COARSE_REACH_PX <= _tiles.OVERLAP_PX
                a, b = picture(*size, np.float32), picture(*size, np.float32, seed=1)
                network = ready(model())
                whole = network.restore(a, b)
                monkeypatch.setattr(_tiles, "tiles", partial(_tiles.tiles, most_px=500**2))
                assert len(_tiles.tiles(*size)) == 4
                assert np.abs(network.restore(a, b) - whole).max() < 1e-6
                # it would: less around them changes the result
                if model is small.coarse:
                    monkeypatch.setattr(_tiles, "OVERLAP_PX", 160)
                    assert np.abs(network.restore(a, b) - whole).max() > 1e-2


def test_blur_goes_to_its_part(monkeypatch):
    blur, a = turning(700, 500, longest_px=30), picture(500, 700, np.float32)
    network = ready(small.seeing_blur(), "lsd2")
    whole = network.restore(a, a, blur)
    monkeypatch.setattr(_tiles, "tiles", partial(_tiles.tiles, most_px=500**2))
    np.testing.assert_array_equal(network.restore(a, a, blur), whole)


# --- threads -------------------------------------------------------------------------------------------------------


def test_one_network_serves_several_threads():
    network = ready(small.coarse(), threads=1)
    pairs = [(picture(200, 150 + 16 * i, seed=i), picture(200, 150 + 16 * i, seed=50 + i)) for i in range(12)]
    alone = [network.restore(*pair) for pair in pairs]
    with ThreadPoolExecutor(6) as pool:
        for together, before in zip(pool.map(lambda pair: network.restore(*pair), pairs), alone, strict=True):
            np.testing.assert_array_equal(together, before)


def test_threads_are_as_many_as_asked_for_or_as_may_be_used():
    for asked, given in ((None, usable_processors()), (3, 3)):
        network = ready(small.mixing(), threads=asked)
        assert network.threads == given
        assert network._session.get_session_options().intra_op_num_threads == given
    with pytest.raises(ValueError, match="threads must be at least 1"):
        ready(small.mixing(), threads=0)


def test_workers_and_the_threads_they_share_are_as_many_as_processors(subtests, monkeypatch):
    for processors, workers, expected in ((1, 1, 1), (2, 2, 1), (4, 4, 1), (8, 4, 5), (16, 4, 13), (2, 4, 1)):
        with subtests.test(processors=processors, workers=workers):
            monkeypatch.setattr(threads, "usable_processors", partial(int, processors))
            assert threads.threads_beside(workers) == expected


def test_a_device_that_fails_is_told_with_what_to_do(monkeypatch):
    class Failing:
        def run(self, outputs, feeds):
            raise RuntimeError("Failed to allocate memory for requested buffer of size 7\nat somewhere")

    for device, advice in (("cuda", "CUDA_VISIBLE_DEVICES"), ("cpu", "half a gigabyte")):
        network = replace(ready(small.mixing()), device=device, _session=Failing())
        with pytest.raises(InertialError, match=rf"deepgyro failed on {device} \(Failed .* size 7\); .*{advice}"):
            network.restore(picture(20, 30), picture(20, 30))


# --- the files -----------------------------------------------------------------------------------------------------


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A folder of small networks in place of the package's."""
    small.write_weights(tmp_path / "weights", deepgyro=small.mixing(), lsd2=small.mixing(0.25))
    monkeypatch.setattr(shipped, "folder", lambda: tmp_path / "weights")
    return tmp_path / "weights"


def test_a_network_in_use_is_loaded_once(weights, monkeypatch):
    made, of = [], Network.of
    monkeypatch.setattr(Network, "of", lambda *a, **k: made.append(a) or of(*a, **k))
    with ThreadPoolExecutor(6) as pool:
        loaded = list(pool.map(lambda _: load_network("deepgyro", device="cpu"), range(12)))
    assert len(made) == 1 and len(set(map(id, loaded))) == 1
    assert load_network("deepgyro", threads=usable_processors(), device="cpu") is loaded[0]
    other = load_network("deepgyro", device="cpu", threads=usable_processors() + 1), load_network("lsd2", device="cpu")
    assert len(made) == 3 and other[1].name == "lsd2"
    loaded.clear()
    load_network("deepgyro", device="cpu")  # nobody kept it
    assert len(made) == 4


def test_a_missing_package_is_told_with_the_command_that_installs_it(weights, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    for need in (require_network, load_network, lambda name: Network.of(b"", name, source="x")):
        with pytest.raises(MissingExtraError, match="extra `restore`: pip install 'onnxruntime") as told:
            need("deepgyro")
        assert told.value.extra == "restore"


def test_missing_and_damaged_files_are_told(weights):
    require_network("deepgyro")
    model = (weights / "deepgyro.onnx").read_bytes()
    (weights / "deepgyro.onnx").write_bytes(model[:40] + bytes([model[40] ^ 1]) + model[41:])
    for need in (require_network, load_network):
        with pytest.raises(FormatError, match=r"deepgyro.onnx: is damaged .* install colmap-inertial again"):
            need("deepgyro")
    (weights / "deepgyro.onnx").unlink()
    with pytest.raises(FormatError, match=r"deepgyro.onnx: is missing; install"):
        require_network("deepgyro")
    for text in ("", "[]", '{"lsd2.onnx": "x"}', '{"deepgyro.onnx": 3}'):
        (weights / "checksums.json").write_text(text)
        with pytest.raises(FormatError, match=r"checksums.json: does not name the network deepgyro"):
            require_network("deepgyro")
    (weights / "checksums.json").unlink()
    with pytest.raises(FormatError, match=r"checksums.json: is missing"):
        require_network("deepgyro")


def same(**sizes):
    return small.network([helper.make_node("Identity", ["picture"], ["restored"])], sizes={**small.SIZES, **sizes})


WRONG = {
    "no ONNX": (b"not a network", "onnxruntime cannot read it"),
    "no blur": (
        small.network(
            [helper.make_node("Add", ["picture", "aid"], ["restored"])],
            sizes={k: v for k, v in small.SIZES.items() if k != "blur"},
        ),
        r"inputs picture tensor\(float\), aid tensor\(float\) and the outputs restored; .* picture, aid, blur",
    ),
    "another output": (
        small.network([helper.make_node("Add", ["picture", "aid"], ["out"])], output="out"),
        "and the outputs out; a network",
    ),
    "other numbers": (
        small.network(
            [helper.make_node("Cast", ["picture"], ["restored"], to=TensorProto.FLOAT)], kind=TensorProto.FLOAT16
        ),
        r"tensor\(float16\)",
    ),
    "one channel": (same(picture=[1, 1, "h", "w"]), "does not run on 48 x 32 px"),
    "one size": (same(picture=[1, 3, 32, 48]), "does not run on 32 x 48 px"),
    "blur of the full size": (
        small.network([helper.make_node("Add", ["picture", "blur"], ["restored"])]),
        "does not run on 48 x 32 px",
    ),
    "half a picture": (
        small.network(
            [helper.make_node("AveragePool", ["picture"], ["restored"], kernel_shape=[2, 2], strides=[2, 2])]
        ),
        r"returns \(1, 3, 16, 24\) for an input of \(1, 3, 32, 48\); an image must keep its size",
    ),
}


def test_what_is_no_network_for_pictures_is_told(subtests):
    for what in WRONG:
        with subtests.test(what=what):
            model, words = WRONG[what]
            with pytest.raises(FormatError, match=f"small.onnx: .*{words}"):
                ready(model)


def test_cuda_asked_for_by_name_must_be_there(weights, monkeypatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(InertialError, match="onnxruntime-gpu"):
        load_network("deepgyro", device="cuda")
    assert load_network("deepgyro").device == "cpu"


def test_cuda_that_does_not_start_is_an_error_by_name_and_no_error_otherwise(weights, monkeypatch):
    monkeypatch.setattr(networks, "_choose_device", lambda device: "cpu" if device == "cpu" else "cuda")
    monkeypatch.setattr(networks, "_CUDA", "AzureExecutionProvider")  # onnxruntime leaves out what it does not have
    start = networks._start_session
    monkeypatch.setattr(
        networks, "_start_session", lambda model, source, device, threads: start(model, source, "cpu", threads)
    )
    kept = load_network("deepgyro")
    assert kept.device == "cpu"
    with pytest.raises(InertialError, match="cannot run on CUDA"):
        load_network("deepgyro", device="cuda")


# --- DeepGyro and LSD2 ---------------------------------------------------------------------------------------------


def test_a_network_that_takes_the_filter_s_word_makes_what_the_filter_makes(subtests):
    for dtype in (np.uint8, np.uint16):
        for channels in (1, 3):
            with subtests.test(dtype=dtype, channels=channels):
                image, blur = scene(170, 230, dtype, channels), turning(230, 170)
                path = BlurPath.straight(blur)
                filtered = path_wiener(image, path)
                made = deepgyro.deblur(image, path, network=ready(small.mixing(1.0)))
                assert made.dtype == dtype and made.shape == image.shape
                fully = around(np.hypot(*np.moveaxis(blur.per_pixel(), -1, 0)) > 1)
                np.testing.assert_array_equal(made[fully], filtered[fully])
                assert (made[fully] != image[fully]).mean() > 0.5


def test_pixels_without_blur_stay_bit_for_bit(subtests):
    for channels in (1, 3):
        with subtests.test(channels=channels):
            image, blur = scene(170, 230, channels=channels), turning(230, 170)
            darker = ready(small.mixing(0.0, channels=(0.5, 0.5, 0.5)))
            original = image.copy()
            made = deepgyro.deblur(image, BlurPath.straight(blur), network=darker)
            length = np.hypot(*np.moveaxis(blur.per_pixel(), -1, 0))
            still = around(length < 0.5)
            assert still.mean() > 0.03
            np.testing.assert_array_equal(made[still], image[still])
            full = around(length > 1)
            assert np.abs(made[full] - 0.5 * image[full]).max() < 0.51
            np.testing.assert_array_equal(image, original)


def test_blur_longer_than_the_network_knows_is_the_filter_s():
    image = scene(130, 400)
    darker = ready(small.mixing(0.0, channels=(0.5, 0.5, 0.5)))
    rows, columns = BlurField.nodes(400, 130)
    length = np.broadcast_to(np.linspace(45, 100, columns), (rows, columns))
    blur = BlurField(width=400, height=130, vector_px=np.stack([length, 0 * length], axis=-1))
    path = BlurPath.straight(blur)
    made, filtered = deepgyro.deblur(image, path, network=darker), path_wiener(image, path)
    at = blur.per_pixel()[..., 0]
    long, short = around(at > 80), around(at < 60)
    assert long.mean() > 0.2 and short.mean() > 0.2
    np.testing.assert_array_equal(made[long], filtered[long])
    assert np.abs(made[short] - 0.5 * image[short]).max() < 0.51
    # blended between them
    share = np.clip((80 - at) / 20, 0, 1)[..., None]
    off = np.abs(made - (filtered + share * (0.5 * image - filtered)))
    assert off.max() < 8 and np.mean(off > 1.1) < 0.05
    entirely = BlurPath.straight(BlurField.uniform(400, 130, (0.0, 90.0)))
    np.testing.assert_array_equal(deepgyro.deblur(image, entirely, network=darker), path_wiener(image, entirely))


def test_the_filter_that_the_network_sees_follows_the_curve():
    image, curved = scene(200, 260), arc(260, 200, 24.0)
    made = deepgyro.deblur(image, curved, network=ready(small.mixing(1.0)))
    np.testing.assert_array_equal(made, path_wiener(image, curved))
    straight = path_wiener(image, BlurPath.straight(curved.field()))
    assert np.abs(made.astype(int) - straight).mean() > 1


def test_a_sharp_picture_is_returned_as_it_is():
    image, path = picture(64, 80), BlurPath.straight(BlurField.uniform(80, 64, (0.3, 0.1)))
    made = deepgyro.deblur(image, path, network=ready(small.mixing(0, (0, 0, 0))))
    np.testing.assert_array_equal(made, image)


def test_exposures_are_fused_in_the_short_one_s_type():
    network = ready(small.mixing(0.25), "lsd2")
    short, long = picture(50, 60, np.float32), picture(50, 60, np.uint8, seed=1)
    fused = lsd2.fuse(short, long, blur=BlurField.uniform(60, 50, (9, 2)), network=network)
    assert fused.dtype == np.float32
    np.testing.assert_allclose(fused, 0.75 * short + 0.25 * (long / 255), atol=1e-6)
    codes = lsd2.fuse(picture(50, 60, np.uint16), long, network=network)
    assert codes.dtype == np.uint16


def test_one_network_is_not_taken_for_the_other():
    image = picture(32, 32)
    with pytest.raises(ValueError, match="network: deepgyro, not lsd2"):
        path = BlurPath.straight(BlurField.uniform(32, 32, (5, 0)))
        deepgyro.deblur(image, path, network=ready(small.mixing(), "lsd2"))
    with pytest.raises(ValueError, match="network: lsd2, not deepgyro"):
        lsd2.fuse(image, image, network=ready(small.mixing()))


# --- the networks of the package -----------------------------------------------------------------------------------


@pytest.fixture(params=["deepgyro", "lsd2"])
def name(request):
    return request.param


def test_the_package_has_whole_networks_of_the_right_kind(name):
    require_network(name)
    assert len(shipped.read_model(name)) < 10e6
    network = load_network(name, device="cpu")
    image = scene(200, 300)
    lines = BlurField.uniform(300, 200, (8, 3))
    restored = network.restore(image, image, BlurPath.straight(lines) if name == "deepgyro" else lines)
    assert restored.shape == image.shape and np.abs(restored.astype(int) - image).mean() < 20


def test_parts_of_the_package_s_networks_do_not_show(name, monkeypatch):
    network = load_network(name, device="cpu")
    a, lines = scene(520, 640), turning(640, 520, longest_px=25)
    path = BlurPath.straight(lines)
    b, blur = path_wiener(a, path), path if name == "deepgyro" else lines
    whole = network.restore(a / np.float32(255), b, blur)
    monkeypatch.setattr(_tiles, "tiles", partial(_tiles.tiles, most_px=500**2))
    assert len(_tiles.tiles(520, 640)) == 4
    off = np.abs(network.restore(a / np.float32(255), b, blur) - whole)
    assert off.max() < 0.01 / 255


def test_the_example_in_the_documentation_runs(name):
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "imaging.md").read_text(), re.M | re.S)
    (code,) = (block for block in blocks if "colmap_inertial.imaging.restoration" in block)
    values: dict[str, object] = {}
    exec(compile(ast.parse(code), "imaging.md", "exec"), values)
    for made, flat in ((values["sharp"], 90), (values["clean"], 0.4)):
        # the outermost pixels know less
        assert np.abs(np.asarray(made, float)[8:-8, 8:-8] / flat - 1).max() < 0.03


def test_checksums_name_the_files_that_are_there():
    there = {file.name for file in shipped.folder().iterdir() if file.name.endswith(".onnx")}
    assert there == {"deepgyro.onnx", "lsd2.onnx"}
    assert set(json.loads(shipped.folder().joinpath("checksums.json").read_text())) == there
