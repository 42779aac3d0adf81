"""Standard error while a command is at work: findings, bars, what is kept; lines where it is no terminal."""

from __future__ import annotations

import bisect
import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_inertial.core.printing import open_console

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Bars, TaskID

    from colmap_inertial.diagnose import Diagnosis

_STAGES = {
    "rendering": "Rendering",
    "video": "Video frames",
    "check": "Recording check",
    "motion": "Camera motion",
    "clocks": "Clocks",
    "selection": "Selection",
    "calibration": "Calibration",
    "survey": "Small models",
    "blur": "Blur",
    "frames": "Frames",
    "fusing": "Fused",
    "features": "Features",
    "matches": "Matches",
    "mapping": "Mapping",
    "images": "Images",
    "metric": "Metric scale",
    "validation": "Validation",
    "apply": "Files",
    "dense": "Dense",
    "mesh": "Mesh",
    "export": "Images",
}
SEVERITY_COLOUR = {"info": "blue", "warning": "yellow", "error": "red"}

#: In a pipe, a stage that takes longer says how far it is no more often than this.
_LINE_S = 10.0


def clock(seconds: float) -> str:
    """A duration as minutes and seconds, with hours where there are any."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """Time of a stage against its steps: it grows with this power of the share of steps done.

    Measured on the example scene and EuRoC (``scripts/studies/progress.py``), where the times left of features,
    matches, mapping and depth maps are within a factor of two after a tenth of each stage, by the processors' time.
    Steps of ``work`` are units of work, shown as a percentage.
    """

    power: float = 1.0
    #: Share of its time that comes after its last step.
    end: float = 0.0
    work: bool = False


#: An image costs more, the more are in the model, and all are adjusted once more at the end. Where a stage is not here,
#: its steps are alike.
_COSTS = {
    "mapping": StageCost(power=1.2, end=0.12),
    "matches": StageCost(work=True),
    "dense": StageCost(work=True),
}


class Stage:
    """Progress of one stage, with elapsed and remaining time.

    A stage that goes on where an earlier run was begins above zero; what that run did does not count for its speed. Its
    speed is that of the last half of what is done: first steps are often slower. Time in which only the total changed
    counts for none.
    """

    def __init__(self, now_s: float, done: int, total: int, outputs: Sequence[Path] = (), *, name: str = "") -> None:
        self._outputs, self._cost = outputs, _COSTS.get(name, StageCost())
        self._from, self._begun_s, self._moved_s = done, now_s, now_s
        self._moves, self._paused_s = [(done, now_s)], 0.0
        self.done, self.total = done, total

    def moved(self, now_s: float, done: int, total: int) -> None:
        """So many steps are done."""
        if done > self.done:
            self._moves.append((done, now_s - self._paused_s))
        elif done < self.done:  # it begins again, with the next model
            self._from, self._moves = done, [(done, now_s - self._paused_s)]
        elif total != self.total:
            self._paused_s += now_s - self._moved_s
        if (done, total) != (self.done, self.total):
            self._moved_s = now_s
        self.done, self.total = done, total

    @property
    def counts_work(self) -> bool:
        """Tell whether its steps are units of work instead of things to count."""
        return self._cost.work

    def seconds(self, now_s: float) -> float:
        """Elapsed time of the stage."""
        return now_s - self._begun_s

    def left_s(self, now_s: float) -> float | None:
        """Remaining time at the present speed.

        ``None`` at the beginning, where the end is unknown, and where a step takes longer than all of them should have.
        """
        if self.done <= self._from or self.done > self.total:
            return None
        half = (self._from + self.done) / 2
        behind = bisect.bisect_left(self._moves, (half,))
        (low, low_s), (high, high_s) = self._moves[behind - 1 : behind + 1]
        half_s = low_s + (high_s - low_s) * (half - low) / (high - low)
        begun, done = (self._share(steps) for steps in (half, self.done))
        left_s = (1 - done) * (self._moves[-1][1] - half_s) / (done - begun) - (now_s - self._moved_s)
        return left_s if left_s >= 0 else None

    def _share(self, steps: float) -> float:
        """Share of the stage's time that so many steps take."""
        return (1 - self._cost.end) * float((steps / self.total) ** self._cost.power)

    def count(self) -> str:
        """Steps done, and of how many; before the first one is done, what has been written."""
        counted = f"{self.done}/{self.total}" if self.total else ""
        if self._cost.work and self.total:
            counted = f"{100 * self.done // self.total} %"
        written = sum(_size(path) for path in self._outputs) if self.done <= self._from else 0
        return f"{counted} ({written / 1e6:.0f} MB)" if counted and written > 1e6 else counted

    def ends_in(self, now_s: float) -> str:
        """The same in words; empty at its end."""
        if self.total and self.done >= self.total:
            return ""
        left_s = self.left_s(now_s)
        return "" if left_s is None else f"{clock(left_s)} left"


def _size(path: Path) -> int:
    """Bytes of a file, and of SQLite's log beside a database."""
    size = 0
    for file in (path, path.with_name(f"{path.name}-wal")):
        with contextlib.suppress(OSError):
            size += file.stat().st_size if file.is_file() else 0
    return size


class Screen:
    """Display of a running command."""

    def __init__(self, console: Console, bars: Bars, now: Callable[[], float] = time.monotonic) -> None:
        self._console, self._bars, self._now = console, bars, now
        self._tasks: dict[str, TaskID] = {}
        self._stages: dict[str, Stage] = {}
        self._said_s: dict[str, float] = {}
        self._ended: set[str] = set()
        self._outputs: dict[str, Sequence[Path]] = {}
        self._kept: list[str] = []
        self._worked = False

    @property
    def unchanged(self) -> bool:
        """Whether all steps were kept from an earlier run."""
        return not self._worked

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Show how far a stage is."""
        now = self._now()
        if stage not in self._stages:
            self._say_kept()
            self._stages[stage] = Stage(now, done, total, self._outputs.get(stage, ()), name=stage)
            self._tasks[stage] = self._bars.add_task(_name_stage(stage), total=None, stage=self._stages[stage])
            self._line(f"{_name_stage(stage)} ...")
            self._said_s[stage] = now
        known = self._stages[stage]
        known.moved(now, done, total)
        self._bars.update(self._tasks[stage], completed=done, total=total if done else None)
        if stage in self._ended or now - self._said_s[stage] < _LINE_S:
            return
        self._said_s[stage] = now
        if total and done >= total:
            self._ended.add(stage)
            self._line(f"{_name_stage(stage)} {known.count()}, took {clock(known.seconds(now))}")
        else:
            counted = known.count() or ("" if known.counts_work else f"{done}")
            self._line(", ".join(filter(None, [f"{_name_stage(stage)} {counted}".rstrip(), known.ends_in(now)])))

    def kept(self, step: str, /) -> None:
        """A step of an earlier run stands."""
        self._kept.append(step)

    def began(self, step: str, outputs: Sequence[Path], /) -> None:
        """A step begins."""
        self._worked = True
        self._outputs[step] = tuple(outputs)
        self._say_kept()

    def noted(self, sentence: str, /) -> None:
        """Why something is made again."""
        self._console.print(sentence, soft_wrap=not self._console.is_terminal, markup=False, highlight=False)

    def _say_kept(self) -> None:
        if self._kept:
            names = ", ".join(_name_stage(stage).lower() for stage in self._kept)
            self._kept.clear()
            self._console.print(f"kept from the earlier run: {names}", soft_wrap=not self._console.is_terminal)

    def _line(self, text: str) -> None:
        if not self._console.is_terminal:
            self._console.print(text, soft_wrap=True, highlight=False)

    def findings(self, diagnosis: Diagnosis, *, stops: bool = False) -> None:
        """Say what was found before the work: errors and warnings; above the bars, and whole lines in a pipe.

        Parameters
        ----------
        diagnosis
            What was found.
        stops
            Whether a finding that makes metres meaningless ends the run: the first one is then left to the error that
            says so.
        """
        from rich.text import Text

        findings = [finding for finding in diagnosis.findings if finding.severity != "info"]
        stopping = diagnosis.stopping[0] if stops and diagnosis.stopping else None
        for finding in findings:
            if finding is stopping:
                continue
            severity = (f"{finding.severity}: ", f"bold {SEVERITY_COLOUR[finding.severity]}")
            line = Text.assemble(severity, f"{finding.evidence}; {finding.advice}", (f" ({finding.code})", "dim"))
            self._console.print(line, soft_wrap=not self._console.is_terminal)
        if diagnosis.worst == "error" and stopping is None:
            self._console.print("an error makes a scale wrong or impossible; Ctrl-C ends the run")


def _name_stage(stage: str) -> str:
    return _STAGES.get(stage, stage.replace("_", " ").capitalize())


@contextlib.contextmanager
def live_progress(*, quiet: bool, verbose: bool) -> Iterator[Screen]:
    """The screen of a command that takes a while."""
    from rich.progress import BarColumn, Progress as Bars, ProgressColumn, SpinnerColumn, Task, TextColumn
    from rich.text import Text

    class Count(ProgressColumn):
        """Steps done, and of how many."""

        def render(self, task: Task) -> Text:
            stage: Stage = task.fields["stage"]
            return Text(stage.count(), "progress.download")

    class Clock(ProgressColumn):
        """Elapsed and remaining time of a stage."""

        def render(self, task: Task) -> Text:
            stage: Stage = task.fields["stage"]
            seconds = task.finished_time if task.finished_time is not None else task.elapsed
            time_left = "" if task.finished else stage.ends_in(time.monotonic())
            return Text.assemble(
                "took ", (clock(seconds or 0.0), "progress.elapsed"), f", {time_left}" if time_left else ""
            )

    console = open_console(stderr=True, quiet=quiet)
    columns: tuple[Any, ...] = (
        SpinnerColumn(finished_text=" "),
        TextColumn("{task.description:<13}"),
        BarColumn(bar_width=24),
        Count(),
        Clock(),
    )
    # the log goes line by line beside no bars
    shown = console.is_terminal and not quiet and not verbose
    bars = Bars(*columns, console=console, disable=not shown)
    with bars if shown else contextlib.nullcontext():  # rich before 14.3 ends hidden bars with a newline
        screen = Screen(console, bars)
        yield screen
