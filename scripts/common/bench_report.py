"""Machine, versions and commit of a run, written beside its figures."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGES = ("colmap-inertial", "pycolmap", "numpy", "scipy", "opencv-contrib-python-headless")


def describe_run() -> dict[str, Any]:
    """Machine, versions, commit."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "machine": {"system": platform.platform(), "processor": (names or [platform.processor()])[0]},
        "cores": os.cpu_count(),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "commit": ask_git("rev-parse", "HEAD"),
        "modified": bool(ask_git("status", "--porcelain", "--", "../../colmap_inertial", "..")),
    }


def ask_git(*arguments: str) -> str:
    """What git prints in this folder; empty where it fails."""
    here = Path(__file__).resolve().parent
    done = subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


def write_report(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON with :func:`describe_run`, whose keys they may replace; nothing without a path."""
    if path is not None:
        text = json.dumps({**describe_run(), **figures}, indent=1)
        path.write_text(text.replace("NaN", "null") + "\n")
