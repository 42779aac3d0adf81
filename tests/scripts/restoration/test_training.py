"""Training of the restoration networks; needs the extra ``train``."""

import lzma
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="the extra `train` is not installed")
pytest.importorskip("onnxruntime", reason="the extra `restore` is not installed")
import torch

from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles
from colmap_inertial.imaging.restoration._tiles import OVERLAP_PX, Span, path_feed
from scripts.restoration import samples
from scripts.restoration.camera import jpeg, noisy, srgb
from scripts.restoration.export import export, weights_of
from scripts.restoration.handheld import recorded, simulated
from scripts.restoration.network import RestorationNet
from scripts.restoration.optics import ShotOptions, draw_shots
from scripts.restoration.photographs import photographs
from scripts.restoration.pool import Pool, Sources, make_pool
from scripts.restoration.training import TrainOptions, train, turned


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    """A folder of drawn pictures."""
    folder, rng = tmp_path_factory.mktemp("photos"), np.random.default_rng(0)
    for i in range(12):
        picture = np.full((360, 400, 3), rng.integers(40, 200, 3), dtype=np.uint8)
        for _ in range(60):
            a, b = rng.integers(0, 400, (2, 2))
            cv2.rectangle(picture, a.tolist(), b.tolist(), rng.integers(0, 255, 3).tolist(), int(rng.integers(1, 9)))
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder


def drawn_shots(blur_px, seed):
    rng = np.random.default_rng(seed)
    return draw_shots(simulated(2, 3), np.asarray(blur_px), rng, ShotOptions(side=128, widths=(640, 1280)), "cpu")


def test_a_point_smears_by_what_the_blur_field_says():
    shots = drawn_shots([20.0, 14.0, 25.0], 3)
    scene = torch.zeros(3, 3, 192, 192)
    scene[:, :, 96, 96] = 1
    smeared, sharp = shots.render(scene, 64)[:, 0].numpy(), shots.render(scene, 1)[:, 0].numpy()
    at = np.arange(128) + 0.5

    def moments(light):
        weight = light / light.sum()
        x, y = (weight.sum(0) * at).sum(), (weight.sum(1) * at).sum()
        dx, dy = at - x, (at - y)[:, None]
        return np.array([x, y]), 12 * np.array([(weight * m).sum() for m in (dx * dx, dy * dy, dx * dy)])

    for i in range(3):
        middle, spread = moments(smeared[i])
        place, own = moments(sharp[i])
        there = torch.tensor(middle, dtype=torch.float32)[:, None]
        x, y = (float(v) for v in shots.blur(*there)[i, 0, 0])
        # a segment of length L has second moments of L^2 / 12; interpolation widens points by up to a pixel
        np.testing.assert_allclose(spread - own, [x * x, y * y, x * y], atol=0.012 * (x * x + y * y) + 1)
        # where the path is bent, the smear lies to one side
        mean = shots.path(*there, middles(64).tolist())[:, i, 0, 0].mean(dim=0).numpy()
        np.testing.assert_allclose(middle + mean, place, atol=0.15)
    # as long as was wanted, but for what the rolling shutter makes of it
    middle = torch.tensor([64.0])
    np.testing.assert_allclose(shots.blur(middle, middle)[:, 0, 0].norm(dim=-1), [20, 14, 25], rtol=0.3)


def test_a_point_s_light_stands_on_its_path_in_the_sharp_picture():
    shots = drawn_shots([25.0, 18.0], 11)
    scene = torch.zeros(2, 3, 192, 192)
    scene[:, :, 96, 96] = 1
    at = np.arange(128) + 0.5
    for part in (-0.4, 0.3):
        # the whole exposure at one part of it
        moved = replace(shots, exposure_s=0 * shots.exposure_s, t_s=shots.t_s - part * shots.exposure_s[:, None])
        then, middle = (s.render(scene, 1)[:, 0].numpy() for s in (moved, shots))
        for i in range(2):
            places = [
                np.array([(a[i].sum(0) * at).sum(), (a[i].sum(1) * at).sum()]) / a[i].sum() for a in (then, middle)
            ]
            x, y = (torch.tensor([v], dtype=torch.float32) for v in places[0])
            q = shots.path(x, y, (part,))[0, i, 0, 0].numpy()
            assert np.hypot(*q) > 2
            np.testing.assert_allclose(places[0] + q, places[1], atol=0.25)


def test_recordings_turn_by_their_gyroscope_and_move_by_motion_capture(tmp_path):
    t_ns = 10**18 + np.arange(0, 5 * 10**9, 5_000_000)
    rate = np.stack([np.sin(np.arange(len(t_ns)) / 50), 0.3 + 0 * t_ns, -0.2 + 0 * t_ns], axis=1)
    gt_ns = 10**18 + np.arange(0, 5 * 10**9, 8_333_333)
    t_s = (gt_ns - gt_ns[0]) * 1e-9
    # a body that is turned by a right angle about z, and goes along the world's x
    pose = np.stack([0.7 * t_s, 0 * t_s, 0 * t_s, *(v + 0 * t_s for v in (0.5**0.5, 0, 0, 0.5**0.5))], axis=1)
    for kind, ns, values in (("imu", t_ns, rate), ("gt", gt_ns, pose)):
        with lzma.open(tmp_path / f"walk_{kind}.csv.xz", "wt") as file:
            file.write("#timestamp\n")
            file.writelines(
                ",".join([str(n), *(f"{v:.9f}" for v in row)]) + "\n" for n, row in zip(ns, values, strict=True)
            )
    (piece,) = recorded(tmp_path, "walk")
    found, velocity = piece.at(np.array([1.0, 2.5]))
    np.testing.assert_allclose(found, rate[[200, 500]], atol=1e-6)
    np.testing.assert_allclose(velocity, [[0, -0.7, 0]] * 2, atol=1e-5)


def test_jpeg_is_that_of_the_usual_library():
    rng = np.random.default_rng(1)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (96, 128, 3)).astype(np.uint8), (0, 0), 1.5)
    for quality in (50, 75, 95):
        _, packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
        expected = cv2.imdecode(packed, cv2.IMREAD_COLOR_RGB).astype(float)
        code = torch.from_numpy(picture[..., ::-1].copy()).permute(2, 0, 1)[None].float() / 255
        found = 255 * jpeg(code, torch.tensor([float(quality)]), torch.tensor([True]))[0].permute(1, 2, 0).numpy()
        lost = np.abs(expected - picture[..., ::-1]).mean()
        assert np.abs(found - expected).mean() < 0.35 * lost


@pytest.mark.parametrize("grain", [0.0, 0.5, 1.0])
def test_noise_is_as_strong_as_asked_for(grain):
    light = torch.full((1, 3, 256, 256), 0.4)
    found = noisy(
        light,
        torch.full((1, 3), 0.02),
        torch.full((1, 3), 0.001),
        torch.tensor([grain]),
        torch.Generator().manual_seed(0),
    )
    assert float((found - light).std()) == pytest.approx((0.02**2 + 0.001 * 0.4) ** 0.5, rel=0.02)


def test_srgb_is_that_of_the_package():
    from colmap_inertial.imaging.transfer import srgb_from_linear

    light = np.linspace(-0.1, 1.2, 500)
    np.testing.assert_allclose(srgb(torch.tensor(light)), srgb_from_linear(light), atol=1e-7)


def test_blur_turns_with_the_picture(photos):
    size = samples.SIDE
    rows = np.linspace(2, 9, BlurField.nodes(size, size)[0])[:, None, None] * [1.0, 0.3]
    field = BlurField(width=size, height=size, vector_px=np.broadcast_to(rows, (*BlurField.nodes(size, size), 2)))
    bend = np.array([8.0, -3.0])
    arc = middles(17)[:, None, None, None] * field.vector_px + middles(17)[:, None, None, None] ** 2 * bend
    path = BlurPath(width=size, height=size, step_px=field.step_px, path_px=arc.astype(np.float32))
    picture = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), dtype=np.uint8)
    whole = Span(begin=0, end=size, keep_begin=0, keep_end=size)
    blur = path_feed(path, whole, whole).transpose(0, 2, 3, 1).astype(np.float16)
    one = samples.Samples(picture=picture, aid=picture, truth=picture, blur=blur)
    v = field.per_pixel()
    ways = set()
    for seed in range(30):
        out = turned(one, np.random.default_rng(seed))
        grey = out.picture.sum(axis=-1)[0]
        for flip_x, flip_y, transpose in np.ndindex(2, 2, 2):
            moved, w, a = picture.sum(axis=-1)[0], v, bend / 32
            moved, w, a = (moved[:, ::-1], w[:, ::-1] * [-1, 1], a * [-1, 1]) if flip_x else (moved, w, a)
            moved, w, a = (moved[::-1], w[::-1] * [1, -1], a * [1, -1]) if flip_y else (moved, w, a)
            moved, w, a = (moved.T, w.swapaxes(0, 1)[..., ::-1], a[::-1]) if transpose else (moved, w, a)
            if np.array_equal(moved, grey):
                ways.add((flip_x, flip_y, transpose))
                x, y = w[::2, ::2].transpose(2, 0, 1)
                length = np.hypot(x, y)
                expected = np.stack([(x * x - y * y) / length, 2 * x * y / length, length], axis=-1) / 32
                np.testing.assert_allclose(out.blur[0, ..., :3], expected, atol=0.01)
                np.testing.assert_allclose(out.blur[0, ..., 3:], np.broadcast_to(a, expected[..., :2].shape), atol=2e-3)
    assert len(ways) == 8


def test_held_out_photographs_are_never_trained_on(photos):
    train_on, kept = photographs(photos, held_out=False), photographs(photos, held_out=True)
    assert kept and train_on
    assert sorted(train_on + kept) == sorted(photos.iterdir())


@pytest.fixture(scope="module")
def pools(photos, tmp_path_factory) -> tuple[Pool, Pool]:
    """Sixteen samples to train on, and sixteen others."""
    folder = tmp_path_factory.mktemp("pools")
    return tuple(
        make_pool(
            folder / str(held_out),
            samples.deepgyro_samples,
            Sources(photos=photos, motion=None, held_out=held_out),
            16,
            seed=5,
            device="cpu",
            workers=1,
        )
        for held_out in (False, True)
    )


def test_an_interrupted_training_ends_as_one_that_was_not(pools, tmp_path, monkeypatch):
    from scripts.restoration import training

    monkeypatch.setattr(training, "_KEEP_EVERY", 2)
    options = TrainOptions(steps=4, batch=4, warm_up=1)
    weights = []
    for name, stops in (("whole", False), ("parts", True)):
        torch.manual_seed(0)
        network = RestorationNet()
        if stops:
            torch.manual_seed(0)
            with pytest.raises(RuntimeError, match="power cut"), monkeypatch.context() as context:
                loss, calls = training._loss, []

                def failing(*args, loss=loss, calls=calls):
                    calls.append(1)
                    if len(calls) == 4:
                        raise RuntimeError("power cut")
                    return loss(*args)

                context.setattr(training, "_loss", failing)
                train(network, *pools, tmp_path / name, options, device="cpu")
            network = RestorationNet()
        figures = train(network, *pools, tmp_path / name, options, device="cpu")
        weights.append(network.state_dict())
        assert set(figures["held_out_psnr_db"]["4"]) == {"picture", "aid", "restored"}
    for name, value in weights[0].items():
        torch.testing.assert_close(value, weights[1][name], rtol=0, atol=1e-6)


def test_what_is_exported_computes_what_was_trained(pools, tmp_path):
    import onnxruntime

    torch.manual_seed(1)
    network = RestorationNet()
    for parameter in network.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    export(network, tmp_path / "some.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "some.onnx"), providers=["CPUExecutionProvider"])
    picture, aid = torch.rand(2, 1, 3, 64, 96)
    blur = torch.rand(1, 5, 32, 48)
    inputs = {"picture": picture, "aid": aid, "blur": blur}
    (found,) = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    with torch.no_grad():
        np.testing.assert_allclose(found, network(picture, aid, blur).numpy(), atol=2e-3)


def test_training_goes_on_from_what_was_exported(tmp_path):
    torch.manual_seed(2)
    trained = RestorationNet(3)
    for parameter in trained.parameters():
        parameter.data += 0.02 * torch.randn_like(parameter)
    export(trained, tmp_path / "some.onnx")
    # one that is told more of the blur than that takes no notice of it at first
    told = RestorationNet(5)
    told.load_state_dict(weights_of(tmp_path / "some.onnx", told))
    picture, aid = torch.rand(2, 1, 3, 64, 96)
    blur = torch.rand(1, 5, 32, 48)
    with torch.no_grad():
        torch.testing.assert_close(told(picture, aid, blur), trained(picture, aid, blur[:, :3]), rtol=0, atol=2e-3)
    with pytest.raises(SystemExit, match=r"enter\.weight has the shape"):
        weights_of(tmp_path / "some.onnx", RestorationNet(2))


def test_faint_texture_that_is_lost_counts_as_strong_edges_do():
    from scripts.restoration.training import _loss

    x = torch.arange(64.0).expand(64, 64)
    wave = torch.sin(x / 2)[None, None].expand(1, 3, 64, 64)
    grey = torch.full_like(wave, 0.5)
    lost = {contrast: float(_loss(grey, grey + contrast * wave)) for contrast in (0.0, 0.1, 0.4)}
    # without that term it would be four times as much
    assert lost[0.0] < 0.003 < 0.06 < lost[0.1] and lost[0.4] < 3.5 * lost[0.1]


def test_the_network_looks_no_further_than_its_parts_overlap(monkeypatch):
    from scripts.restoration import network as networks

    # every weight and slope 1e-3: what has any way to a pixel has a derivative
    monkeypatch.setattr(networks.functional, "leaky_relu", lambda x, slope: x)
    network = RestorationNet().double()
    for parameter in network.parameters():
        parameter.data.fill_(1e-3)
    begin, end = 400, 416
    seen = set()
    for which in range(2):
        pictures = [torch.ones(1, 3, 48, 832, dtype=torch.float64) for _ in range(2)]
        pictures[which].requires_grad_()
        restored = network(*pictures, torch.ones(1, 5, 24, 416, dtype=torch.float64))
        (slope,) = torch.autograd.grad(restored[..., 16:32, begin:end].sum(), pictures[which])
        (at,) = (slope != 0).any(dim=2).flatten(0, 1).any(dim=0).nonzero(as_tuple=True)
        seen.add((begin - int(at.min()), int(at.max()) + 1 - end))
    assert seen == {(182, 182)} and OVERLAP_PX >= 182


def test_both_networks_samples_are_of_one_kind(pools, photos):
    rng = np.random.default_rng(0)
    material = samples.Material.load(photos, None)
    for maker in (samples.deepgyro_samples, samples.lsd2_samples):
        made = maker(material, 2, rng, "cpu")
        inner = samples.SIDE - 2 * samples.MARGIN
        assert made.picture.shape == made.aid.shape == made.truth.shape == (2, inner, inner, 3)
        channels = samples.BLUR_CHANNELS[maker.__name__]
        assert made.blur.shape == (2, inner // 2, inner // 2, channels) and np.isfinite(made.blur).all()
        assert made.truth.std() > 10


def test_a_clock_that_is_late_shows_the_blur_of_another_time():
    shots = drawn_shots([15.0], 8)
    middle = torch.tensor([64.0])
    later = replace(shots, turn_rad=shots.turned(shots.t_s + 4e-3))
    # the exposure 4 ms later, by the motion itself
    moved = replace(shots, t_s=shots.t_s - 4e-3)
    still = replace(later, moved_m=0 * shots.moved_m), replace(moved, moved_m=0 * shots.moved_m)
    torch.testing.assert_close(still[0].blur(middle, middle), still[1].blur(middle, middle), rtol=0.02, atol=0.05)
