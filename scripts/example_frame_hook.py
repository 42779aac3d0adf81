"""Reconstruct a capture with a frame hook of one's own: local contrast, for dark and hazy pictures.

    python scripts/example_frame_hook.py CAPTURE OUT [--config options.toml]

A frame hook stands between decoding and feature extraction. It takes an iterator of frames and gives one back, so it
may change pixels, leave frames out or look at several at a time. A frame that it does not touch is copied byte for
byte.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial import Action, Frame, ReconstructOptions, read_config, reconstruct


# A frozen dataclass rather than a function: its fields then belong to what decides whether an interrupted run may keep
# the images that it wrote earlier.
@dataclass(frozen=True)
class LocalContrast:
    """CLAHE on the brightness of frames that need it."""

    below: float = 60.0
    """Only frames whose standard deviation of brightness is below this; of 255."""
    clip: float = 2.0

    def __call__(self, frames: Iterator[Frame], /) -> Iterator[Frame]:
        """Frames in, frames out: one in memory at a time."""
        equalize = cv2.createCLAHE(clipLimit=self.clip, tileGridSize=(8, 8))
        for frame in frames:
            if frame.image.dtype != np.uint8 or frame.image.ndim != 3 or frame.image.std() >= self.below:
                yield frame
                continue
            lab = cv2.cvtColor(frame.image, cv2.COLOR_RGB2LAB)
            lab[..., 0] = equalize.apply(lab[..., 0])
            # Frames are read-only; the name, which stays, is what joins image, time and pose.
            yield replace(frame, image=cv2.cvtColor(lab, cv2.COLOR_LAB2RGB))


def main() -> None:
    """Reconstruct, and say which frames were changed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--below", type=float, default=LocalContrast.below)
    parser.add_argument("--config", type=Path, help="options as TOML, such as OUT/config.toml of another run")
    args = parser.parse_args()
    options = ReconstructOptions() if args.config is None else read_config(args.config, ReconstructOptions)
    # The dots stand for the default frame stages (deblurring): theirs first, then ours.
    result = reconstruct(args.capture, args.out, options, frame_stages=[..., LocalContrast(below=args.below)])
    print(f"{sum(frame.action is Action.CHANGED for frame in result.frames)} of {len(result.frames)} frames changed")
    for model in result.models:
        print(f"model {model.index}: {model.scale.verdict}, {model.scale.metres_per_unit} metres per unit")


if __name__ == "__main__":
    main()
