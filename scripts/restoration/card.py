"""Model cards: what a network is, what it was made of, and what was measured."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import torch

from restoration.network import DOWN, UP, WIDTHS, RestorationNet, parameters

_PURPOSE = {
    "deepgyro": "Undoes motion blur that a gyroscope knows of, with errors. Takes the blurred picture, the result of "
    "the directional Wiener filter, and the blur of each pixel.",
    "lsd2": "Makes one clean picture of a short, noisy exposure and a long, blurred one. Takes the short one at the "
    "long one's brightness, the long one aligned to it, and the long one's blur where it is known.",
}
_DATA = """\
Photographs: CID22 (Cloudinary, CC BY-SA 4.0) and CLIC 2025 (photographers on Unsplash, Unsplash licence); one in five,
by name, was held out. Motion: ground truth of TUM-VI rooms 1 and 3 (Schubert et al. 2018, CC BY 4.0) and the package's
simulator; room 5 was held out. Nothing else was used. Blur, rolling shutter, noise, clipping, sharpening and JPEG are
computed (`scripts/restoration/`).
"""


def write_card(path: Path, name: str, figures: dict[str, Any], *, samples: int, device: str) -> None:
    """Write the card of a network, Markdown.

    Parameters
    ----------
    name
        ``deepgyro`` or ``lsd2``.
    figures
        What :func:`restoration.training.train` returned.
    samples
        How many it was trained on.
    """
    machine = torch.cuda.get_device_name() if device == "cuda" else _processor()
    options = figures["options"]
    rows = [
        f"| {step} | {f['picture']} | {f['aid']} | {f['restored']} |" for step, f in figures["held_out_psnr_db"].items()
    ]
    first, second = ("blurred", "Wiener") if name == "deepgyro" else ("short", "long")
    path.write_text(
        f"""# {name}

{_PURPOSE[name]}

- Architecture: residual U-Net at half the picture's size, {parameters(RestorationNet()) / 1e6:.2f} million weights;
  {WIDTHS} channels at 1/2 to 1/16, {DOWN} blocks down, {UP} up (`scripts/restoration/network.py`). Half precision on
  disk.
- Training: {samples} pieces of 192 x 192 px, {options["steps"]} steps of {options["batch"]}, AdamW,
  rate {options["rate"]} along a cosine, seed {options["seed"]}; {figures["seconds"] / 60:.0f} minutes on {machine},
  PyTorch {torch.__version__}.
- To make it again: `python scripts/train_restoration.py {name} --photos FOLDER --motion FOLDER --work FOLDER`
- Licence of the weights: as the package's.

## Data and attribution

{_DATA}
## PSNR on held-out pieces, dB (photographs and motion never trained on)

| steps | {first} | {second} | restored |
| --- | --- | --- | --- |
"""
        + "\n".join(rows)
        + "\n\nWhat it does to whole frames, features and reconstructions: `scripts/bench_restoration.py`.\n"
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} cores of {names[0]}" if names else platform.machine()
