"""Sessions, recordings and frames for tests of single steps."""

from pathlib import Path

import cv2
import numpy as np

from colmap_inertial.colmap.context import RunContext
from colmap_inertial.core.types import CameraModel, Frame, FrameTiming
from colmap_inertial.io.calibration import calibration_prior
from colmap_inertial.io.capture import Capture
from colmap_inertial.io.recording import Recording
from colmap_inertial.run.steps.runner import StepRunner
from colmap_inertial.run.steps.session import Session

CAMERA = CameraModel(model="PINHOLE", width=32, height=24, params=(30, 30, 16, 12))


def frames_of(folder, count=6):
    """Six grey pictures as JPEG files, and the frames that a reader would deliver."""
    rng = np.random.default_rng(0)
    names = tuple(f"{i}.jpg" for i in range(count))
    folder.mkdir()
    for name in names:
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (24, 32), dtype=np.uint8))
    timing = FrameTiming(names=names, t_s=np.arange(count))
    frames = (
        Frame(name=name, image=cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED), t_s=float(i), camera=CAMERA)
        for i, name in enumerate(names)
    )
    return timing, frames


def session_in(workspace):
    return Session(workspace=workspace, runner=StepRunner(workspace), context=RunContext(scratch=workspace.stamps))


def recording_of(imu, timing):
    capture = Capture(path=Path("capture.toml"), calibration=calibration_prior())
    return Recording.of(capture, imu, timing, capture.calibration)
