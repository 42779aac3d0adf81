"""Throughput of ``colmap-inertial apply`` against ``cp`` of the same bytes, and its memory.

    python scripts/bench_apply.py FOLDER [--gigabytes 5] [--runs 5] [--json FILE]

Makes a dense workspace in FOLDER (a disk with three times the room) that holds only what changes: a small model, depth
maps (four fifths of the bytes), a fused cloud with normals and colours, a mesh with double coordinates. Then, in turns,
``colmap-inertial apply`` (scale, rotation, translation) and ``cp -r --reflink=never`` copy it, each a process of its
own, each followed by ``sync``; what they wrote is removed before the next turn. Printed: every run's seconds, the
medians, the ratio of throughputs, and the peak memory of the process. Everything is removed in the end.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from colmap_inertial.core.geometry import quat_exp

WIDTH, HEIGHT = 2000, 1500
CLOUD = [*((n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")), *((n, "u1") for n in ("red", "green", "blue"))]
NAMES = {"<f4": "float", "<f8": "double", "u1": "uchar"}


def write_model(folder: Path) -> None:
    """A small model: what a dense workspace has beside its large files."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 20, 2000
    pycolmap.set_random_seed(0)
    folder.mkdir(parents=True)
    pycolmap.synthesize_dataset(options).write_binary(str(folder))


def write_points(path: Path, fields: list[tuple[str, str]], count: int, triangles: int) -> None:
    """A PLY file of random points, with triangles where there are any."""
    rng = np.random.default_rng(0)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    header += "".join(f"property {NAMES[kind]} {name}\n" for name, kind in fields)
    if triangles:
        header += f"element face {triangles}\nproperty list uchar int vertex_indices\n"
    block = 1 << 18
    with open(path, "wb") as file:
        file.write(f"{header}end_header\n".encode())
        rows = np.zeros(block, fields)
        for name, kind in fields:
            rows[name] = rng.integers(0, 255, block) if kind == "u1" else rng.standard_normal(block)
        for start in range(0, count, block):
            rows[: count - start].tofile(file)
        faces = np.zeros(block, [("n", "u1"), ("indices", "<i4", 3)])
        faces["n"], faces["indices"] = 3, rng.integers(0, count, (block, 3))
        for start in range(0, triangles, block):
            faces[: triangles - start].tofile(file)


def write_workspace(folder: Path, size: float) -> None:
    """About ``size`` bytes."""
    write_model(folder / "sparse")
    maps = folder / "stereo" / "depth_maps"
    maps.mkdir(parents=True)
    depth = np.random.default_rng(1).uniform(1, 9, (HEIGHT, WIDTH)).astype("<f4")
    depth[:, ::7] = 0
    for i in range(max(1, round(0.8 * size / depth.nbytes))):
        data = b"%d&%d&1&" % (WIDTH, HEIGHT) + (depth + np.float32(i)).tobytes()
        (maps / f"{i // 2:05}.jpg.{('photometric', 'geometric')[i % 2]}.bin").write_bytes(data)
    write_points(folder / "fused.ply", CLOUD, round(0.15 * size / 27), 0)
    vertices = round(0.05 * size / 50)
    write_points(folder / "meshed-poisson.ply", [(n, "<f8") for n in ("x", "y", "z")], vertices, 2 * vertices)


def timed(command: list[str]) -> tuple[float, float]:
    """Seconds until the disk has everything, and peak memory of the process in MB."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{command[0]} ended with {process.returncode}")
    os.sync()
    return time.perf_counter() - start, usage.ru_maxrss / 1024


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gigabytes", type=float, default=5.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(args.folder).free
    if free < 3e9 * args.gigabytes:
        raise SystemExit(f"{args.folder} has {free / 1e9:.1f} GB free; {3 * args.gigabytes:.1f} are needed")
    root = Path(tempfile.mkdtemp(prefix="bench_apply", dir=args.folder))
    try:
        workspace, similarity = root / "workspace", root / "similarity.json"
        write_workspace(workspace, 1e9 * args.gigabytes)
        rotation = quat_exp(np.array([0.3, -0.2, 0.9])).tolist()
        similarity.write_text(json.dumps({"scale": 0.37, "rotation_xyzw": rotation, "translation_m": [1, 2, 3]}))
        size = sum(p.stat().st_size for p in workspace.rglob("*") if p.is_file())
        os.sync()
        apply = [sys.executable, "-m", "colmap_inertial", "apply", str(workspace), str(root / "out")]
        commands = {
            "apply": [*apply, "--sim3", str(similarity)],
            "cp": ["cp", "-r", "--reflink=never", str(workspace), str(root / "out")],
        }
        seconds: dict[str, list[float]] = {name: [] for name in commands}
        memory = 0.0
        for run in range(args.runs):
            for name in sorted(commands, reverse=run % 2 == 1):
                taken, peak = timed(commands[name])
                seconds[name].append(taken)
                memory = max(memory, peak) if name == "apply" else memory
                shutil.rmtree(root / "out")
                os.sync()
                print(f"{name:6} {taken:7.2f} s  {size / taken / 1e6:7.0f} MB/s", flush=True)
    finally:
        shutil.rmtree(root)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    ratio = medians["cp"] / medians["apply"]
    print(f"{size / 1e9:.2f} GB: apply {medians['apply']:.2f} s, cp {medians['cp']:.2f} s (medians of {args.runs})")
    print(f"throughput {100 * ratio:.0f} % of cp's (target 80 %), peak memory {memory:.0f} MB (target 500 MB)")
    if args.json is not None:
        commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
        found = {
            "bytes": size,
            "seconds": seconds,
            "throughput_of_cp": ratio,
            "peak_memory_mb": memory,
            "machine": {"processor": platform.processor(), "cores": os.cpu_count(), "system": platform.platform()},
            "commit": commit,
        }
        args.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
