"""IMU samples of a quiet hand, as the table of EuRoC has them."""

from pathlib import Path

import numpy as np

HEADER = "#timestamp [ns],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"
EPOCH_NS = 1403715273262142976


def handheld(n: int = 400, rate_hz: float = 200.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (ns), rad/s and m/s2 that a quiet hand could have made."""
    rng = np.random.default_rng(seed)
    t_ns = EPOCH_NS + (np.arange(n) * 1e9 / rate_hz).astype(np.int64)
    gyro = 0.3 * np.sin(np.arange(n)[:, None] / [31.0, 47.0, 23.0]) + rng.normal(0, 0.01, (n, 3))
    accel = np.array([0.5, 9.7, 1.0]) + rng.normal(0, 0.1, (n, 3))
    return t_ns, gyro, accel


def rows(t_ns, gyro, accel) -> list[str]:
    return [
        ",".join(map(repr, (int(t), *map(float, g), *map(float, a)))) for t, g, a in zip(t_ns, gyro, accel, strict=True)
    ]


def write_csv(path: Path, lines: list[str], header: str | None = HEADER) -> Path:
    path.write_text("\n".join(([header] if header else []) + lines) + "\n")
    return path
