"""What reads a recording's images before COLMAP, as a run has it."""

from pathlib import Path

from colmap_inertial.io.recording import Recording
from colmap_inertial.run.preparation.frame_reading import FullFrames, GreyFrames


def readers(recording: Recording, scratch: Path = Path()) -> tuple[GreyFrames, FullFrames]:
    """Of all its images, and of those to use."""
    every = GreyFrames(recording.capture, recording.every, scratch)
    return every, FullFrames(recording.capture, recording.timing, scratch)
