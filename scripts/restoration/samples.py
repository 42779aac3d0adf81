"""Training samples of both networks: what a camera recorded, what the network is told, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from colmap_inertial.core.arrays import Array, Float32Array, UInt8Array
from colmap_inertial.imaging.blur_field import BlurField
from colmap_inertial.imaging.blur_path import BlurPath, middles, samples_for
from colmap_inertial.imaging.path_filters import DeblurOptions, path_wiener
from colmap_inertial.imaging.restoration._tiles import Span, blur_feed, path_feed
from scripts.restoration.camera import jpeg, light_of, noisy, sharpened, srgb
from scripts.restoration.handheld import Handheld, recorded, simulated
from scripts.restoration.optics import ShotOptions, Shots, draw_shots
from scripts.restoration.photographs import Album, photographs

#: Pieces are made so large, and lose this much at each edge, so that few see an edge as only pictures' edges are.
SIDE, MARGIN = 256, 32
#: Spacing of what the gyroscope says of the blur: of lines, and of paths, as the package has them.
_NODE_PX, _PATH_NODE_PX = 16, 64
#: Scenes reach so far beyond the pieces.
_BEYOND_PX = 48
_WHOLE = Span(begin=0, end=SIDE, keep_begin=0, keep_end=SIDE)
#: Errors of usual gyroscopes (standard deviations): of clock, direction and extent; and what share of each calibrations
#: say of themselves.
_LATE_S, _ANGLE_RAD, _EXTENT = 3e-3, np.radians(3), 0.1
_CALIBRATED = np.array([1 / 6, 0.1, 0.0])
#: The recording that is never trained on.
HELD_OUT_MOTION = "room5"
_TRUTH = "_gt.csv.xz"


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples:
    """B samples, (B, S, S, 3) uint8 each, and (B, S / 2, S / 2, C) float16 blur as the networks take it."""

    picture: UInt8Array
    aid: UInt8Array
    blur: NDArray[np.float16]
    truth: UInt8Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Material:
    """Photographs and motions, either those to train on or those to measure with."""

    album: Album
    motions: list[Handheld]

    @classmethod
    def load(cls, photos: Path, motion: Path | None, *, held_out: bool = False) -> Material:
        """From a folder of photographs, and one of recorded motion; without it, the simulator's motion alone."""
        motions = simulated(8, 1000 if held_out else 0)
        if motion is not None:
            names = [p.name.removesuffix(_TRUTH) for p in sorted(motion.glob(f"*{_TRUTH}"))]
            names = [name for name in names if (name == HELD_OUT_MOTION) == held_out]
            if not names:
                raise SystemExit(f"{motion} holds no recording (NAME_imu.csv.xz, NAME{_TRUTH}) of this kind")
            motions += [piece for name in names for piece in recorded(motion, name)]
        return cls(album=Album(photographs(photos, held_out=held_out)), motions=motions)


#: Of each maker's samples.
BLUR_CHANNELS = {"deepgyro_samples": 5, "lsd2_samples": 3}
Maker = Callable[[Material, int, np.random.Generator, str], Samples]


def deepgyro_samples(material: Material, count: int, rng: np.random.Generator, device: str) -> Samples:
    """Blurred pieces, the result of Wiener's filter along the path of a gyroscope with errors, and that path.

    One in eight is sharp and has a blur that is not there; in one in eight, the gyroscope is right. The filter is told
    how large the errors may be in half of them; in the others, of the small ones that a calibration usually has.
    """
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    longest = rng.choice([6.0, 14.0, 24.0, 40.0], p=[0.2, 0.3, 0.3, 0.2])
    blur_px = rng.uniform(0.3 * longest, longest, count)
    shots = draw_shots(material.motions, blur_px, rng, ShotOptions(side=SIDE), device)
    false = torch.tensor(rng.random(count) < 0.125, device=device)
    paths = told_paths(shots, rng)
    shots = replace(shots, exposure_s=torch.where(false, rng.uniform(0, 0.08) * shots.exposure_s, shots.exposure_s))
    scene = _scenes(material.album, count, rng, device)
    light = shots.render(scene, max(12, int(1.2 * longest)))
    truth = srgb(shots.render(scene, 1))
    picture = _bytes(_photographed(light, rng, generator, least=0.003, most=0.02))
    one = DeblurOptions(threads=1)
    aid = np.stack([path_wiener(np.ascontiguousarray(p), q, one) for p, q in zip(picture, paths, strict=True)])
    return _trimmed(picture, aid, [path_feed(path, _WHOLE, _WHOLE) for path in paths], _bytes(truth))


def told_paths(shots: Shots, rng: np.random.Generator) -> list[BlurPath]:
    """B paths by a gyroscope with errors, and how wrong the filter is told that they may be.

    Errors are those of :func:`told_blur`.
    """
    wrong = _wrong(shots, rng)
    at = torch.arange(BlurField.nodes(SIDE, SIDE, _PATH_NODE_PX)[0], device=shots.t_s.device) * float(_PATH_NODE_PX)
    at += 0.5
    longest = float(wrong.shots.blur(at, at).norm(dim=-1).max())
    path = wrong.turned(wrong.shots.path(at, at, middles(samples_for(longest)).tolist())).cpu().numpy()
    # how the chord would be if the clock were a little later
    late = replace(wrong.shots, turn_rad=wrong.shots.turned(wrong.shots.t_s + _LATE_S))
    change = (late.blur(at, at) - wrong.shots.blur(at, at)).cpu().numpy() / _LATE_S
    told = rng.random(len(path[0])) < 0.5
    errors = wrong.size.cpu().numpy()[:, None, None, None]
    out = []
    for i, known in enumerate(told):
        chord = path[-1, i] - path[0, i]
        across = np.stack([-chord[..., 1], chord[..., 0]], axis=-1)
        usual = (_LATE_S * change[i], _ANGLE_RAD * across, _EXTENT * chord)
        shares = errors[i] * np.ones(3) if known else _CALIBRATED
        cov = sum(
            (share * w)[..., [0, 0, 1]] * (share * w)[..., [0, 1, 1]]
            for share, w in zip(shares.ravel(), usual, strict=True)
        )
        out.append(
            BlurPath(
                width=SIDE, height=SIDE, step_px=_PATH_NODE_PX, path_px=path[:, i], cov_px2=np.asarray(cov, np.float32)
            )
        )
    return out


@dataclass(frozen=True, eq=False, kw_only=True)
class _Wrong:
    """What a gyroscope with errors takes shots for: paths and lines of ``shots``, (B,) turned and stretched.

    ``size`` is that of the errors, usual ones = 1.
    """

    shots: Shots
    angle_rad: Tensor
    size: Tensor

    def turned(self, vectors: Tensor) -> Tensor:
        """(..., B, h, w, 2) by the angle."""
        cos, sin = (f(self.angle_rad)[:, None, None] for f in (torch.cos, torch.sin))
        x, y = vectors.unbind(-1)
        return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def _wrong(shots: Shots, rng: np.random.Generator) -> _Wrong:
    count, device = len(shots.t_s), shots.t_s.device

    def normal(sd: float, *shape: int) -> Tensor:
        return torch.tensor(sd * rng.standard_normal((count, *shape)), dtype=torch.float32, device=device)

    drawn = rng.uniform(0, 1.6, count)
    much = torch.tensor(np.where(rng.random(count) < 0.125, 0, drawn), dtype=torch.float32, device=device)
    late = normal(_LATE_S) * much
    translated = torch.tensor(rng.random(count) > 1 / 3, device=device) | (much == 0)
    drift = normal(0.01, 3) * much[:, None]
    centre = normal(0.03, 2) * (much * shots.focal_px)[:, None]
    turn = shots.turned(shots.t_s + late[:, None]) + drift[:, None] * shots.t_s[..., None]
    wrong = replace(
        shots,
        turn_rad=turn,
        moved_m=shots.moved_m * translated[:, None, None],
        corner_px=shots.corner_px + centre,
        exposure_s=shots.exposure_s * torch.exp(normal(_EXTENT) * much),
    )
    return _Wrong(shots=wrong, angle_rad=normal(_ANGLE_RAD) * much, size=much)


def told_blur(shots: Shots, rng: np.random.Generator) -> Tensor:
    """(B, G, G, 2) blur at the nodes by a gyroscope with errors.

    Errors are of clock (3 ms), extent (10 %), direction (3 degrees), turning (drift of 0.01 rad/s), the point about
    which a roll turns (3 % of the focal length), and of what the camera's translation does: not known at all in one
    of three. They are up to 1.6 times as large in some samples, and none at all in one of eight.
    """
    wrong = _wrong(shots, rng)
    at = torch.arange(SIDE // _NODE_PX + 1, device=shots.t_s.device) * float(_NODE_PX) + 0.5
    return wrong.turned(wrong.shots.blur(at, at))


def lsd2_samples(material: Material, count: int, rng: np.random.Generator, device: str) -> Samples:
    """Short exposures, noisy, and long ones, blurred and not quite in place; the truth is the short one without noise.

    As a network is given them: the short one brought to the long one's brightness, the long one aligned. In half of
    them the blur of the long one is not known.
    """
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    longest = rng.choice([4.0, 12.0, 24.0, 36.0], p=[0.15, 0.3, 0.3, 0.25])
    blur_px = rng.uniform(0.2 * longest, longest, count)
    exposure_s = np.exp(rng.uniform(np.log(0.02), np.log(0.1), count))
    shots = draw_shots(material.motions, blur_px, rng, ShotOptions(side=SIDE), device, exposure_s=exposure_s)
    told = told_blur(shots, rng)
    scene = _scenes(material.album, count, rng, device)
    ratio = torch.tensor(np.exp(rng.uniform(np.log(4), np.log(30), count)), dtype=torch.float32, device=device)
    brief = replace(shots, exposure_s=shots.exposure_s / ratio)
    # what is left of where the long one lies after alignment, and of its size and direction
    off_px = torch.tensor(rng.standard_normal((count, 2)) * rng.gamma(1.0, 1.5, (count, 1)), dtype=torch.float32)
    light = shots.render(scene, max(12, int(1.2 * longest)), shift_px=off_px.to(device))
    clean = brief.render(scene, max(1, int(0.5 * longest)))
    truth = srgb(brief.render(scene, 1))
    aid = _bytes(_photographed(light, rng, generator, least=0.002, most=0.03))
    # colours of the short one differ a little, and its brightness is not matched exactly
    tint = torch.tensor(1 + 0.04 * rng.standard_normal((count, 3)), dtype=torch.float32, device=device)
    tint = torch.where(_colourless(scene)[:, 0, 0], tint[:, :1], tint)
    gain = torch.tensor(1 + 0.05 * rng.standard_normal(count), dtype=torch.float32, device=device)
    tinted = (clean * (tint * gain[:, None])[:, :, None, None]).clamp(0, 1)
    # half of them stored as dark as they were
    dimmed = torch.where(torch.tensor(rng.random(count) < 0.5, device=device), ratio.clamp_max(16), 1.0)
    noisy_codes = _photographed(tinted, rng, generator, least=0.015, most=0.15, uneven=0.25, dimmed=dimmed)
    picture = _bytes(noisy_codes)
    for i in np.flatnonzero(rng.random(count) < 0.2):
        # beyond the edge of the long one there is the short one
        edge = MARGIN + int(rng.integers(1, 64))
        where = [np.s_[:edge], np.s_[-edge:], np.s_[:, :edge], np.s_[:, -edge:]][rng.integers(4)]
        aid[i][where] = picture[i][where]
    vectors = torch.where(torch.tensor(rng.random(count) < 0.5)[:, None, None, None].to(device), told, 0 * told)
    return _trimmed(picture, aid, _line_feeds(vectors), _bytes(truth))


def _scenes(album: Album, count: int, rng: np.random.Generator, device: str) -> Tensor:
    """(B, 3, S, S) light, of other brightness than the photographs', lamps brighter than white."""
    side = SIDE + 2 * _BEYOND_PX
    light = torch.from_numpy(np.stack([album.piece(side, rng) for _ in range(count)])).to(device).permute(0, 3, 1, 2)
    bright = torch.tensor(np.exp(rng.uniform(np.log(0.4), np.log(1.3), count)), dtype=torch.float32, device=device)
    lamps = torch.tensor(
        np.where(rng.random(count) < 0.3, rng.uniform(1, 6, count), 0), dtype=torch.float32, device=device
    )
    lamp = ((light - 0.85) / 0.15).clamp(0, 1) * lamps[:, None, None, None]
    grey = torch.tensor(rng.random(count) < 0.25, device=device)[:, None, None, None]
    light = torch.where(grey, light.mean(dim=1, keepdim=True).expand_as(light), light)
    return ((light + lamp) * bright[:, None, None, None]).contiguous()


def _photographed(
    light: Tensor,
    rng: np.random.Generator,
    generator: torch.Generator,
    *,
    least: float,
    most: float,
    uneven: float = 0.0,
    dimmed: Tensor | None = None,
) -> Tensor:
    """Codes of light: clipping, noise, sRGB, sharpening, JPEG.

    The noise of white is from ``least`` to ``most`` of full scale; channels differ by a factor of ``1 + uneven``. What
    was stored (B,) times darker is brightened again.
    """
    count, device = len(light), light.device

    def drawn(values: Array) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=device)

    sigma = np.exp(rng.uniform(np.log(least), np.log(most), count))[:, None] * np.ones(3)
    by_light = rng.random(count)[:, None]
    grain = drawn(np.where(rng.random(count) < 0.4, rng.uniform(0, 0.8, count), 0))
    if uneven:
        sigma *= np.exp(np.log1p(uneven) * rng.standard_normal(sigma.shape))
    out = noisy(light.clamp(0, 1), drawn(sigma * np.sqrt(1 - by_light)), drawn(sigma**2 * by_light), grain, generator)
    # pictures without colour have noise without colour
    out = torch.where(_colourless(light), out[:, :1].expand_as(out), out)
    code = srgb(out if dimmed is None else out / dimmed[:, None, None, None])
    amount = drawn(np.where(rng.random(count) < 0.2, rng.uniform(0.2, 0.8, count), 0))
    code = torch.where(amount[:, None, None, None] > 0, sharpened(code, amount), code)
    code = (255 * code).round() / 255
    packed = torch.tensor(rng.random(count) < 0.5, device=device)[:, None, None, None]
    pressed = jpeg(code, drawn(rng.uniform(75, 98, count)), torch.tensor(rng.random(count) < 0.7, device=device))
    code = torch.where(packed, pressed, code)
    return code if dimmed is None else srgb(light_of(code) * dimmed[:, None, None, None])


def _colourless(light: Tensor) -> Tensor:
    """(B, 1, 1, 1) which pictures have three equal channels."""
    return (light == light[:, :1]).flatten(1).all(dim=1)[:, None, None, None]


def _bytes(code: Tensor) -> UInt8Array:
    """(B, S, S, 3) of (B, 3, S, S) codes 0 to 1."""
    return (255 * code).round().clamp(0, 255).byte().permute(0, 2, 3, 1).contiguous().cpu().numpy()


def _line_feeds(vectors: Tensor) -> list[Float32Array]:
    fields = [BlurField(width=SIDE, height=SIDE, vector_px=v, step_px=_NODE_PX) for v in vectors.cpu().numpy()]
    return [blur_feed(field, _WHOLE, _WHOLE) for field in fields]


def _trimmed(picture: UInt8Array, aid: UInt8Array, feeds: list[Float32Array], truth: UInt8Array) -> Samples:
    inner = slice(MARGIN, SIDE - MARGIN)
    half = slice(MARGIN // 2, (SIDE - MARGIN) // 2)
    blur = np.concatenate(feeds).transpose(0, 2, 3, 1)
    return Samples(
        picture=picture[:, inner, inner],
        aid=aid[:, inner, inner],
        blur=blur[:, half, half].astype(np.float16),
        truth=truth[:, inner, inner],
    )
