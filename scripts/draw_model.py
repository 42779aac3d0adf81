"""Draw a metric model with its camera path and a scale bar: the picture of the README.

    python scripts/draw_model.py out/desk docs/images/desk.jpg

OUT is what ``reconstruct`` wrote. The points of its first model are drawn in their colours, seen from above.
"""

import json
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pycolmap

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def turn(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """(3, 3) the view's right, up and backward axes in a world whose z is up."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    backward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(backward, right), backward])


def draw(out: Path, picture: Path, azimuth_deg: float = -75.0, elevation_deg: float = 40.0) -> None:
    """Write the picture."""
    result = json.loads((out / "result.json").read_text())["models"][0]
    model = pycolmap.Reconstruction(str(out / result["sparse_metric"]))
    points = np.array([p.xyz for p in model.points3D.values()])
    colours = np.array([p.color for p in model.points3D.values()]) / 255
    near = np.linalg.norm(points - np.median(points, axis=0), axis=1) < 1.2
    path = np.loadtxt(out / "trajectory.tum")[:, 1:4]
    view = turn(azimuth_deg, elevation_deg)
    seen, track = points[near] @ view.T, path @ view.T
    order = np.argsort(seen[:, 2])

    figure, (left, axes) = plt.subplots(1, 2, figsize=(10, 4.2), width_ratios=[1, 1.35])
    first = sorted((out / "images").iterdir())[0]
    left.imshow(plt.imread(first), cmap="gray")
    left.set_title("one of the images", fontsize=10)
    left.axis("off")
    axes.scatter(*seen[order, :2].T, c=colours[near][order], s=4, linewidths=0)
    axes.plot(*track[:, :2].T, color="tab:orange", lw=1.5, label="camera path")
    low = np.min(np.vstack([seen, track]), axis=0)[:2]
    axes.plot([low[0], low[0] + 0.5], [low[1] - 0.05] * 2, color="black", lw=3, solid_capstyle="butt")
    axes.text(low[0] + 0.25, low[1] - 0.08, "0.5 m", ha="center", va="top", fontsize=10)
    scale, (low95, high95) = result["metres_per_unit"], result["ci95"]
    half = 50 * (high95 - low95) / scale
    axes.set_title(f"metric model, z up; scale ±{half:.1f} % ({result['verdict']})", fontsize=10)
    axes.set_aspect("equal")
    axes.axis("off")
    axes.legend(loc="lower right", frameon=False, fontsize=9)
    figure.tight_layout()
    figure.savefig(picture, dpi=100, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
