"""How often a run decodes its images, and how long that takes, by step.

    python -m scripts.benchmarks.decodes CAPTURE OUT [--json FILE] [-- OPTIONS OF RECONSTRUCT ...]

Runs ``reconstruct`` in this process and counts what PyAV and OpenCV decode: frames of videos, also those that are only
decoded to reach others, and files of images, also those that the run wrote itself. COLMAP's own reading is not counted.
``per frame`` divides by the frames of the capture.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import av
import cv2

from colmap_inertial.cli import main as run_command
from colmap_inertial.io.capture import load_capture
from colmap_inertial.io.frames import read_frame_timing
from scripts.common.bench_report import write_report
from scripts.common.measured_run import read_run_arguments

#: What is between the steps: reading, the report.
BETWEEN = "between"


class Counter(logging.Handler):
    """Counts decodes and their seconds by the step that the run's log named last."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.step = BETWEEN
        self.found: dict[str, dict[str, float]] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Follow the log of the run."""
        name, colon, what = record.getMessage().partition(": ")
        if colon and what.startswith("started"):
            self.step = name
        elif colon and what.startswith("finished") and name == self.step:
            self.step = BETWEEN

    def add(self, kind: str, seconds: float) -> None:
        """Count one image."""
        one = self.found.setdefault(self.step, {"video": 0, "video_s": 0.0, "files": 0, "files_s": 0.0})
        one[kind] += 1
        one[f"{kind}_s"] += seconds


class CountedContainer:
    """A container of PyAV whose decoded frames are counted."""

    def __init__(self, container: Any, counter: Counter) -> None:
        self._container, self._counter = container, counter

    def __getattr__(self, name: str) -> Any:
        return getattr(self._container, name)

    def __enter__(self) -> CountedContainer:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    def decode(self, *streams: Any) -> Iterator[Any]:
        """The frames, each counted with the time that it took."""
        begun_s = time.perf_counter()
        for frame in self._container.decode(*streams):
            self._counter.add("video", time.perf_counter() - begun_s)
            yield frame
            begun_s = time.perf_counter()


def count_decodes(counter: Counter) -> None:
    """Replace what decodes in PyAV and OpenCV, for the rest of this process."""
    open_container: Callable[..., Any] = av.open
    decode_file: Callable[..., Any] = cv2.imdecode

    def decode(*arguments: Any, **named: Any) -> Any:
        begun_s = time.perf_counter()
        image = decode_file(*arguments, **named)
        counter.add("files", time.perf_counter() - begun_s)
        return image

    setattr(av, "open", lambda *a, **named: CountedContainer(open_container(*a, **named), counter))  # noqa: B010
    setattr(cv2, "imdecode", decode)  # noqa: B010


def main() -> None:
    args = read_run_arguments(__doc__)
    shutil.rmtree(args.out, ignore_errors=True)
    frames = len(read_frame_timing(load_capture(args.capture)).names)
    counter = Counter()
    logging.getLogger("colmap_inertial").addHandler(counter)
    count_decodes(counter)
    begun_s = time.perf_counter()
    code: object = 0
    try:
        run_command(["reconstruct", str(args.capture), str(args.out), "--quiet", *args.options])
    except SystemExit as ended:
        code = ended.code
    whole_s = time.perf_counter() - begun_s
    print(f"exit code {code}, {frames} frames, {whole_s:.1f} s")
    total = {key: sum(one[key] for one in counter.found.values()) for key in ("video", "video_s", "files", "files_s")}
    print(f"{'step':12} of video  seconds  files  seconds")
    for name, one in (*counter.found.items(), ("all", total)):
        print(f"{name:12} {one['video']:8.0f} {one['video_s']:8.2f} {one['files']:6.0f} {one['files_s']:8.2f}")
    print(f"{'per frame':12} {total['video'] / frames:8.2f} {'':8} {total['files'] / frames:6.2f}")
    if args.json:
        write_report(args.json, {"frames": frames, "whole_s": whole_s, "steps": counter.found, "all": total})


if __name__ == "__main__":
    main()
