"""The example scene ``desk``: copies of it, and options by which it is reconstructed in seconds."""

import dataclasses
import shutil
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.core.options import MappingOptions, ReconstructOptions
from colmap_inertial.model import read_model

SCENE = Path(__file__).parents[2] / "example_scenes" / "desk"
#: Enough for an accurate model of this scene, and many times faster than COLMAP's defaults.
FINE = ReconstructOptions(mapping=MappingOptions(max_num_features=600, first_octave=0, max_image_size=400))
#: Enough for a model and a scale of its first frames; three times faster again.
QUICK = ReconstructOptions(mapping=MappingOptions(max_num_features=600, first_octave=0, max_image_size=320))
DETERMINISTIC = dataclasses.replace(
    QUICK, deterministic=True, mapping=dataclasses.replace(QUICK.mapping, max_image_size=240)
)


@cache
def _half_size() -> dict[str, bytes]:
    """The example scene's pictures, half as wide and high, by name."""
    pictures = {path.name: cv2.imread(str(path)) for path in sorted((SCENE / "frames").iterdir())}
    halved = {name: cv2.resize(of, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for name, of in pictures.items()}
    return {name: cv2.imencode(".jpg", of, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes() for name, of in halved.items()}


def copy_scene(folder: Path, *, first: int | None = None, target: bool = False, half: bool = True) -> Path:
    """A copy of the example scene, or of its first frames.

    With its target, a run measures that in seconds more. It is found in pictures of full size alone; most options of
    these tests let COLMAP see at most half of that.
    """
    half = half and not target
    shutil.copytree(SCENE, folder, ignore=lambda _, names: {"frames"} & {*names} if half else ())
    text = (folder / "capture.toml").read_text()
    if half:
        (folder / "frames").mkdir()
        for name, data in _half_size().items():
            (folder / "frames" / name).write_bytes(data)
        for before, after in (
            ("width = 640", "width = 320"),
            ("height = 480", "height = 240"),
            ("[520.0, 520.0, 320.0, 240.0,", "[260.0, 260.0, 160.0, 120.0,"),
        ):
            assert before in text
            text = text.replace(before, after)
    if not target:
        text = text[: text.index("[target]")]
    (folder / "capture.toml").write_text(text)
    if first is not None:
        table = folder / "frames.csv"
        rows = table.read_text().splitlines()
        table.write_text("\n".join(rows[: first + 1]) + "\n")
        for row in rows[first + 1 :]:
            (folder / "frames" / row.split(",")[0]).unlink()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def centres(folder):
    model = read_model(folder)
    images = [model.image(i) for i in model.reg_image_ids()]
    return tuple(image.name for image in images), np.array([image.projection_center() for image in images])
