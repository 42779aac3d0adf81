"""Model cards: what a network is, what it was made of, and what was measured."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import torch

from scripts.restoration.network import DOWN, UP, WIDTHS, RestorationNet, parameters

_PURPOSE = {
    "deepgyro": """\
Undoes motion blur that a gyroscope knows of, with errors. Takes the blurred picture, the result of Wiener's filter
along the path, and the path of each pixel: its chord and its bend.""",
    "lsd2": """\
Makes one clean picture of a short, noisy exposure and a long, blurred one. Takes the short one at the long one's
brightness, the long one aligned to it, and the long one's blur where it is known.""",
}


def write_card(
    path: Path, name: str, figures: dict[str, Any], *, samples: int, begun: str, device: str, attribution: str
) -> None:
    """Write the card of a network, Markdown.

    Parameters
    ----------
    name
        ``deepgyro`` or ``lsd2``.
    figures
        What :func:`restoration.training.train` returned.
    samples
        How many it was trained on.
    begun
        What it went on from; empty where from nothing.
    device
        That trained it.
    attribution
        Markdown: whose photographs and motion it was trained on.
    """
    machine = torch.cuda.get_device_name() if device == "cuda" else _processor()
    options, minutes = figures["options"], figures["seconds"] / 60
    first, second = ("blurred", "Wiener") if name == "deepgyro" else ("short", "long")
    begin = f" --begin {begun}.onnx" if begun else ""
    rows = "\n".join(
        f"| {step} | {psnr['picture']:.2f} | {psnr['aid']:.2f} | {psnr['restored']:.2f} |"
        for step, psnr in figures["held_out_psnr_db"].items()
    )
    path.write_text(
        f"""\
# {name}

{_PURPOSE[name]}

| | |
| --- | --- |
| architecture | residual U-Net at half the picture's size, {parameters(RestorationNet()) / 1e6:.2f} million weights |
| channels | {", ".join(map(str, WIDTHS))} at 1/2 to 1/16; {DOWN} blocks down, {UP} up |
| file | ONNX, weights in half precision, arithmetic in single precision |
| trained on | {samples} pieces of 192 x 192 px, {options["steps"]} steps of {options["batch"]} |
| begun | {f"with the weights of {begun}" if begun else "from nothing"} |
| by | AdamW, rate {options["rate"]} down along a cosine, seed {options["seed"]}; PyTorch {torch.__version__} |
| took | {minutes:.0f} minutes on {machine} |
| licence | the package's; the weights contain none of the photographs |

To make it again, with folders of photographs and recorded motion:

```sh
python -m scripts.restoration.train {name} --photos PHOTOS --motion MOTION --work WORK \\
    --samples {samples} --steps {options["steps"]} --batch {options["batch"]} --rate {options["rate"]} \\
    --seed {options["seed"]}{begin}
```

## Data and attribution

{attribution.strip()}

## PSNR on held-out pieces, dB

Of photographs and motion that it was never trained on, at all strengths of blur, noise and error.

| steps | {first} | {second} | restored |
| --- | --- | --- | --- |
{rows}

What it does to whole frames, features and reconstructions: `python -m scripts.benchmarks.restoration`.
"""
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} cores of {names[0]}" if names else platform.machine()
