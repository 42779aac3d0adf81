"""The training loop that both networks share: seeded, resumable, on a GPU or on processors."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn
from torch.nn import functional

from scripts.restoration.pool import Pool
from scripts.restoration.samples import Samples

console = Console(stderr=True)
#: A squared error below this (in codes 0 to 1) counts linearly no more.
_SMOOTH = 1e-3
#: Weight of the difference of the spectra, which holds on to fine detail.
_SPECTRAL = 0.05
#: Weight of the gradients' difference as features see them: of grey, smoothed by this Gaussian (px), in units of how
#: strong they are around, so that faint texture counts as strong edges do. Below the least (per px), there is none.
_FEATURES, _FEATURE_SIGMA_PX, _AROUND_PX, _LEAST_GRADIENT = 0.04, 1.2, 17, 4e-3
_KEEP_EVERY, _TELL_EVERY = 500, 100
#: Threads that read batches ahead.
_READERS = 4


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What decides the result, beside samples and network."""

    steps: int
    batch: int = 8
    rate: float = 1e-3
    warm_up: int = 300
    averaged: float = 0.999
    seed: int = 0


def train(
    network: nn.Module, pool: Pool, held_out: Pool, folder: Path, options: TrainOptions, *, device: str
) -> dict[str, Any]:
    """Train, or go on where an interrupted run kept its state; returns the figures.

    Parameters
    ----------
    network
        Takes ``picture``, ``aid`` and ``blur``; ends with the running average of its weights.
    folder
        ``state.pt`` (the whole state, every 500 steps) and ``figures.json``.
    """
    torch.manual_seed(options.seed)
    network = network.to(device).train().to(memory_format=torch.channels_last)
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=options.rate, betas=(0.9, 0.95), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _rate(step, options))
    figures: dict[str, Any] = {"options": asdict(options), "held_out_psnr_db": {}, "seconds": 0.0}
    first = 0
    state_path = folder / "state.pt"
    folder.mkdir(parents=True, exist_ok=True)
    if state_path.exists():
        state = torch.load(state_path, map_location=device, weights_only=True)
        if state["figures"]["options"] != asdict(options):
            raise SystemExit(f"{state_path} belongs to other options: name another folder")
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        average, figures, first = state["average"], state["figures"], state["step"]
        console.print(f"going on after {first} steps")
    # elsewhere, it takes longer than single precision does
    short = device == "cuda" or torch.cpu._is_avx512_bf16_supported()
    recent: list[float] = []
    begun, before_s = time.monotonic(), figures["seconds"]
    for step, samples in _batches(pool, options, first):
        picture, aid, blur, truth = _tensors(samples, device)
        with torch.autocast(device, dtype=torch.bfloat16, enabled=short):
            restored = network(picture, aid, blur)
        loss = _loss(restored.float(), truth)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            share = min(options.averaged, (step + 1) / (step + 10))
            for name, value in network.state_dict().items():
                average[name].lerp_(value, 1 - share)
        recent.append(loss.item())
        figures["seconds"] = before_s + time.monotonic() - begun
        last = step + 1 == options.steps
        if (step + 1) % _TELL_EVERY == 0:
            console.print(f"step {step + 1}: loss {np.mean(recent[-_TELL_EVERY:]):.5f}, {figures['seconds']:.0f} s")
        if (step + 1) % _KEEP_EVERY == 0 or last:
            if (step + 1) % (4 * _KEEP_EVERY) == 0 or last:
                found = measured(network, average, held_out, device)
                figures["held_out_psnr_db"][str(step + 1)] = found
                console.print(f"step {step + 1}: held out {found}")
            state = {
                "network": network.state_dict(),
                "average": average,
                "optimiser": optimiser.state_dict(),
                "schedule": schedule.state_dict(),
                "figures": figures,
                "step": step + 1,
            }
            torch.save(state, state_path.with_suffix(".new"))
            state_path.with_suffix(".new").replace(state_path)
            (folder / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
    network.load_state_dict(average)
    return figures


def measured(network: nn.Module, weights: dict[str, Tensor], pool: Pool, device: str) -> dict[str, float]:
    """Mean PSNR, dB, of what goes in and of what comes out with these weights."""
    own = {name: value.clone() for name, value in network.state_dict().items()}
    network.load_state_dict(weights)
    network.eval()
    total: dict[str, list[float]] = {"picture": [], "aid": [], "restored": []}
    with torch.no_grad():
        for start in range(0, len(pool), 8):
            picture, aid, blur, truth = _tensors(pool.batch(range(start, min(start + 8, len(pool)))), device)
            restored = network(picture, aid, blur).clamp(0, 1)
            for name, value in (("picture", picture), ("aid", aid), ("restored", restored)):
                total[name] += (-10 * (value - truth).square().mean(dim=(1, 2, 3)).log10()).tolist()
    network.load_state_dict(own)
    network.train()
    return {name: round(float(np.mean(values)), 3) for name, values in total.items()}


def _rate(step: int, options: TrainOptions) -> float:
    """Factor on the learning rate: up from nothing, then down along a cosine."""
    if step < options.warm_up:
        return (step + 1) / options.warm_up
    part = min((step - options.warm_up) / max(1, options.steps - options.warm_up), 1.0)
    return 1e-3 + (1 - 1e-3) * 0.5 * (1 + float(np.cos(np.pi * part)))


def _loss(restored: Tensor, truth: Tensor) -> Tensor:
    error = restored - truth
    smooth = (error.square() + _SMOOTH**2).sqrt().mean()
    spectral = torch.fft.rfft2(error, norm="ortho").abs().mean()
    wrong, right = _gradients(error), _gradients(truth)
    strength = functional.avg_pool2d(right, _AROUND_PX, 1, _AROUND_PX // 2, count_include_pad=False)
    features = ((wrong + 1e-8).sqrt() / (strength.sqrt() + _LEAST_GRADIENT)).mean()
    return smooth + _SPECTRAL * spectral + _FEATURES * features


def _gradients(picture: Tensor) -> Tensor:
    """(B, 1, H, W) squares of the gradients of smoothed grey, of (B, 3, H + 9, W + 9)."""
    at = torch.arange(-4.0, 5.0, device=picture.device)
    gauss = torch.exp(-0.5 * (at / _FEATURE_SIGMA_PX) ** 2)
    grey = picture.mean(dim=1, keepdim=True)
    grey = functional.conv2d(
        functional.conv2d(grey, (gauss / gauss.sum())[None, None, None]), (gauss / gauss.sum())[None, None, :, None]
    )
    x, y = grey.diff(dim=3)[:, :, 1:], grey.diff(dim=2)[:, :, :, 1:]
    return x.square() + y.square()


def _batches(pool: Pool, options: TrainOptions, first: int) -> Iterator[tuple[int, Samples]]:
    """Steps with their samples, every sample once a round, turned and mirrored at random; read ahead."""
    per_round = len(pool) // options.batch

    def read(step: int) -> Samples:
        turn, place = divmod(step, per_round)
        order = np.random.default_rng([options.seed, turn]).permutation(len(pool))
        samples = pool.batch(order[options.batch * place : options.batch * (place + 1)])
        return turned(samples, np.random.default_rng([options.seed, turn, place]))

    with ThreadPoolExecutor(_READERS) as readers:
        ahead = deque(readers.submit(read, step) for step in range(first, min(first + _READERS, options.steps)))
        for step in range(first, options.steps):
            samples = ahead.popleft().result()
            if step + _READERS < options.steps:
                ahead.append(readers.submit(read, step + _READERS))
            yield step, samples


def turned(samples: Samples, rng: np.random.Generator) -> Samples:
    """All of a batch mirrored or transposed alike, and their colours exchanged; blur follows."""
    flip_x, flip_y, transpose = rng.random(3) < 0.5
    colours = rng.permutation(3)

    def moved(array: Any) -> Any:
        array = array[:, :, ::-1] if flip_x else array
        array = array[:, ::-1] if flip_y else array
        return array.swapaxes(1, 2) if transpose else array

    # the double angle changes its sign when mirrored, and becomes its complement when transposed; a bend is a vector
    signs = [-1 if transpose else 1, -1 if flip_x != flip_y else 1, 1, -1 if flip_x else 1, -1 if flip_y else 1]
    blur = moved(samples.blur) * np.array(signs[: samples.blur.shape[-1]], dtype=np.float16)
    if transpose:
        blur[..., 3:] = blur[..., :2:-1]
    return Samples(
        picture=np.ascontiguousarray(moved(samples.picture)[..., colours]),
        aid=np.ascontiguousarray(moved(samples.aid)[..., colours]),
        truth=np.ascontiguousarray(moved(samples.truth)[..., colours]),
        blur=np.ascontiguousarray(blur),
    )


def _tensors(samples: Samples, device: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(B, 3, H, W) float32, codes 0 to 1."""

    def tensor(array: Any, scale: float) -> Tensor:
        there = torch.from_numpy(array).to(device)
        return (there.permute(0, 3, 1, 2).float() * scale).contiguous(memory_format=torch.channels_last)

    code = 1 / 255
    return (
        tensor(samples.picture, code),
        tensor(samples.aid, code),
        tensor(samples.blur, 1.0),
        tensor(samples.truth, code),
    )
