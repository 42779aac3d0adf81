#!/usr/bin/env python3
"""Train a restoration network, export it and write its model card.

    python -m scripts.restoration.train deepgyro --photos FOLDER --motion FOLDER --work FOLDER

PHOTOS are sharp photographs (.jpg, .png; any folder will do), MOTION holds gyroscopes and motion capture of people who
carry a camera (NAME_imu.csv.xz, NAME_gt.csv.xz as TUM-VI has them; without it the simulator's motion alone is used).
One in five photographs and the motion of one recording are never trained on: figures come from those.

Needs the extra ``train`` (PyTorch, ONNX). Uses a CUDA device where there is one. Started again with the same WORK
folder, it goes on where it was. The defaults are for two processor cores; cards say how shipped weights were made.
``--begin`` goes on from the weights of another network of the same kind (ONNX).
``thesis_unet`` is the yardstick, a U-Net as DeepGyro's own on picture and blur alone; give it --out, the package does
not ship it. On a GPU, train longer on more:

    python -m scripts.restoration.train deepgyro --photos FOLDER --motion FOLDER --work FOLDER \\
        --samples 40000 --steps 60000 --batch 16
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch

from scripts.restoration import samples
from scripts.restoration.card import write_card
from scripts.restoration.export import WEIGHTS, export, weights_of
from scripts.restoration.network import RestorationNet, ThesisNet, parameters
from scripts.restoration.pool import Sources, make_pool
from scripts.restoration.training import TrainOptions, console, train

#: What each network is trained on, how many of it, and how long.
MAKERS = {
    "deepgyro": samples.deepgyro_samples,
    "lsd2": samples.lsd2_samples,
    "thesis_unet": samples.deepgyro_samples,
}
SAMPLES = {"deepgyro": 16_000, "lsd2": 4800, "thesis_unet": 16_000}
STEPS = {"deepgyro": 36_000, "lsd2": 6_000, "thesis_unet": 36_000}
HELD_OUT = 128


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=sorted(MAKERS))
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--motion", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="for samples (0.4 MB each) and the state of training")
    parser.add_argument("--samples", type=int)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rate", type=float, default=TrainOptions.rate)
    parser.add_argument("--begin", dest="begun", type=Path, help="go on from the weights of this network (ONNX)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--width", type=int, default=64, help="of thesis_unet: channels at full size")
    parser.add_argument("--attribution", type=Path, help="text for the card: whose photographs and motion these are")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder for NAME.onnx, its checksum and its card")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    maker, work = MAKERS[args.name], args.work / args.name
    pools = {
        held_out: make_pool(
            work / ("held_out" if held_out else "samples"),
            maker,
            Sources(photos=args.photos, motion=args.motion, held_out=held_out),
            HELD_OUT if held_out else args.samples or SAMPLES[args.name],
            seed=args.seed + held_out,
            device=args.device,
            workers=cores,
        )
        for held_out in (True, False)
    }
    torch.set_num_threads(cores)
    torch.manual_seed(args.seed)
    network = (
        ThesisNet(args.width) if args.name == "thesis_unet" else RestorationNet(samples.BLUR_CHANNELS[maker.__name__])
    )
    if args.begun:
        network.load_state_dict(weights_of(args.begun, network))
    console.print(f"{args.name}: {parameters(network) / 1e6:.2f} million weights, on {args.device}")
    steps = args.steps or STEPS[args.name]
    options = TrainOptions(steps=steps, batch=args.batch, rate=args.rate, warm_up=min(300, steps // 20), seed=args.seed)
    figures = train(network, pools[False], pools[True], work / "training", options, device=args.device)
    target = args.out / f"{args.name}.onnx"
    export(network, target)
    if isinstance(network, RestorationNet):
        write_card(
            target.with_suffix(".md"),
            args.name,
            figures,
            samples=len(pools[False]),
            begun=args.begun.stem if args.begun else "",
            device=args.device,
            attribution=args.attribution.read_text() if args.attribution else "Not stated.",
        )
    console.print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main()
