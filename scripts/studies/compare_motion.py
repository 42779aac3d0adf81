#!/usr/bin/env python3
"""Simulated handheld motion against motion capture, by frequency band.

    python -m scripts.studies.compare_motion ../shared/data/tumvi_mocap [--plot motion.png]

FOLDER holds CSV files of TUM-VI's ground truth: t_ns, x, y, z, qw, qx, qy, qz at 120 Hz. Gaps split a recording. The
simulated motion is sampled, disturbed by the capture system's noise and cut into pieces like the real one, so that
both go through the same estimator; the noise floor is then subtracted from both.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from colmap_inertial.core.geometry import quat_conjugate, quat_exp, quat_log, quat_multiply, slerp
from colmap_inertial.tools.simulate import MotionOptions, make_motion

RATE_HZ = 120.0
MIN_PIECE_S = 8.6
#: The lowest band that pieces of this length resolve; above 12 Hz the capture system's noise hides the motion.
BANDS_HZ = ((0.25, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 12.0))
#: Noise of a sample of the capture system, as found from the spectra above 35 Hz.
NOISE_M, NOISE_RAD = 1.3e-4, 1.1e-3


@dataclass(frozen=True)
class Row:
    """Root mean square of one quantity in one band, real and simulated, mean power over recordings."""

    quantity: str
    band_hz: tuple[float, float]
    real: float
    simulated: float
    real_range: tuple[float, float]


def densities(pieces: list[tuple[NDArray, NDArray, NDArray]]) -> dict[str, NDArray]:
    """One-sided densities of velocity and angular velocity, noise floor subtracted, with their frequencies."""
    total, weight = {}, 0
    for t, position, world_from_body in pieces:
        grid = np.arange(t[0], t[-1], 1 / RATE_HZ)
        p = np.stack([np.interp(grid, t, column) for column in position.T], axis=1)
        q = slerp(t, world_from_body, grid)
        velocity = np.diff(p, axis=0) * RATE_HZ
        rate = quat_log(quat_multiply(quat_conjugate(q[:-1]), q[1:])) * RATE_HZ
        for name, signal in (("velocity", velocity), ("rate", rate)):
            frequency, density = welch(signal, RATE_HZ, nperseg=1024, axis=0, detrend="constant")
            total[name] = total.get(name, 0) + density * len(grid)
        weight += len(grid)
    shape = 4 * np.sin(np.pi * frequency / RATE_HZ) ** 2  # of differenced white noise
    out = {"frequency": frequency}
    for name, density in total.items():
        density = density / weight
        high = frequency > 35
        out[name] = density - np.median(density[high] / shape[high, None], axis=0) * shape[:, None]
    return out


def real_pieces(path: Path) -> list[tuple[NDArray, NDArray, NDArray]]:
    """The uninterrupted pieces of a motion-capture file: time, position, world_from_body."""
    table = np.loadtxt(path, delimiter=",", comments="#")
    t = (table[:, 0] - table[0, 0]) * 1e-9
    cuts = np.flatnonzero(np.diff(t) > 0.02) + 1
    return [
        (t[i], table[i, 1:4], table[i][:, [5, 6, 7, 4]])
        for i in np.split(np.arange(len(t)), cuts)
        if t[i[-1]] - t[i[0]] > MIN_PIECE_S
    ]


def simulated_pieces(kind: str, seed: int, like: list) -> list[tuple[NDArray, NDArray, NDArray]]:
    """Pieces as long as the real ones, with the same noise."""
    rng = np.random.default_rng(seed)
    motion = make_motion(MotionOptions(kind=kind, duration_s=145.0), rng)
    pieces = []
    for t, _, _ in like:
        n = len(t)
        position = motion.cam_in_world_m(t) + NOISE_M * rng.standard_normal((n, 3))
        rotation = quat_multiply(motion.world_from_cam_xyzw(t), quat_exp(NOISE_RAD * rng.standard_normal((n, 3))))
        pieces.append((t, position, rotation))
    return pieces


def band_rms(spectrum: dict[str, NDArray]) -> dict[tuple[str, tuple[float, float]], float]:
    """Rms over a band, all axes together."""
    frequency = spectrum["frequency"]
    out = {}
    for band in BANDS_HZ:
        inside = (frequency >= band[0]) & (frequency < band[1])
        width = frequency[1]
        omega2 = (2 * np.pi * frequency[inside, None]) ** 2
        velocity = spectrum["velocity"][inside]
        out["velocity m/s", band] = np.sqrt(velocity.sum() * width)
        out["acceleration m/s2", band] = np.sqrt((velocity * omega2).sum() * width)
        out["angular rate rad/s", band] = np.sqrt(spectrum["rate"][inside].sum() * width)
    return out


def compare(folder: Path, kind: str = "roam", seed: int = 0) -> list[Row]:
    """Real against simulated, for each quantity and band."""
    files = sorted(folder.glob("*.csv"))
    real = [real_pieces(path) for path in files]
    real_rms = [band_rms(densities(pieces)) for pieces in real]
    fake_rms = [band_rms(densities(simulated_pieces(kind, seed + i, pieces))) for i, pieces in enumerate(real * 3)]
    return [
        Row(
            quantity=key[0],
            band_hz=key[1],
            real=float(np.sqrt(np.mean([r[key] ** 2 for r in real_rms]))),
            simulated=float(np.sqrt(np.mean([r[key] ** 2 for r in fake_rms]))),
            real_range=(float(min(r[key] for r in real_rms)), float(max(r[key] for r in real_rms))),
        )
        for key in sorted(real_rms[0])
    ]


def plot(folder: Path, kind: str, path: Path) -> None:
    """Densities of acceleration and angular rate, real (every recording) and simulated."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    for i, file in enumerate(sorted(folder.glob("*.csv"))):
        pieces = real_pieces(file)
        for source, style in ((pieces, "C0"), (simulated_pieces(kind, i, pieces), "C1")):
            s = densities(source)
            f = s["frequency"][1:160]
            label = None if i else ("real" if style == "C0" else "simulated")
            accel = s["velocity"][1:160].sum(axis=1) * (2 * np.pi * f) ** 2
            axes[0].loglog(f, np.maximum(accel, 1e-9), style, label=label, alpha=0.7)
            axes[1].loglog(f, np.maximum(s["rate"][1:160].sum(axis=1), 1e-9), style, label=label, alpha=0.7)
    for axis, name in zip(axes, ("acceleration, m²/s⁴/Hz", "angular rate, rad²/s²/Hz"), strict=True):
        axis.set(xlabel="Hz", title=name)
        axis.grid(alpha=0.3)
        axis.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print the table; draw the figure where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", default="roam", help="kind of motion (default: roam)")
    parser.add_argument("--plot", type=Path, help="PNG to draw")
    arguments = parser.parse_args()
    print(f"{'quantity':20s} {'band Hz':>10s} {'real':>8s} {'(rooms)':>18s} {'simulated':>10s} {'ratio':>6s}")
    for row in compare(arguments.folder, arguments.kind):
        low, high = row.band_hz
        rooms = f"({row.real_range[0]:.4f}-{row.real_range[1]:.4f})"
        print(
            f"{row.quantity:20s} {low:4.4g}-{high:<4.4g} {row.real:9.4f} {rooms:>18s} {row.simulated:10.4f}"
            f" {row.simulated / row.real:6.2f}"
        )
    if arguments.plot:
        plot(arguments.folder, arguments.kind, arguments.plot)


if __name__ == "__main__":
    main()
