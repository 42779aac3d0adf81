"""Display of a batch on the command line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from colmap_inertial.core.printing import open_console, say
from colmap_inertial.tools.batch import BatchResult, Watch
from colmap_inertial.tools.batch.task import CaptureStatus

_COLOUR = {"done": "green", "failed": "red", "interrupted": "yellow"}


def _outcome(status: CaptureStatus) -> str:
    """One line on how a capture ended."""
    if status.error is not None:
        return f"{status.error} (exit code {status.exit_code})"
    parts = []
    for model in status.models:
        scale = model["metres_per_unit"]
        parts.append(model["verdict"] if scale is None else f"{scale:.6g} m per unit, {model['verdict']}")
    return "; ".join(parts)


@contextlib.contextmanager
def live_batch(*, quiet: bool = False) -> Iterator[Watch]:
    """On standard error: a bar for each running capture, or a line where that is no terminal; a line for each end."""
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = open_console(stderr=True, quiet=quiet)
    clock = (TextColumn("took"), TimeElapsedColumn())
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *clock)
    bars = Progress(*columns, console=console, disable=not console.is_terminal)
    running = {}
    reported: set[str] = set()

    def watch(status: CaptureStatus, /) -> None:
        if status.state == "running" and status.name not in running:
            running[status.name] = bars.add_task(status.name, total=None)
            if not console.is_terminal:
                console.print(f"started {escape(status.name)}", soft_wrap=True, highlight=False)
        if status.findings and status.name not in reported:
            reported.add(status.name)
            for finding in status.findings:
                # what ends a capture is in its last line, too
                if status.error is None or finding.partition(": ")[2].partition("; ")[0] not in status.error:
                    console.print(f"{escape(status.name)} {escape(finding)}", soft_wrap=True, highlight=False)
        if status.state == "running":
            text = f"{escape(status.name)} [dim]{status.stage or 'starts'}[/]"
            bars.update(running[status.name], description=text, completed=status.steps_done, total=status.steps or None)
            return
        if status.name in running:
            bars.remove_task(running.pop(status.name))
        if status.state in _COLOUR:
            colour = _COLOUR[status.state]
            console.print(
                f"[{colour}]{status.state}[/] {escape(status.name)} {escape(_outcome(status))}", soft_wrap=True
            )

    with bars if console.is_terminal else contextlib.nullcontext():
        yield watch


def show_batch(result: BatchResult) -> None:
    """Print how many ended how, and where the table is."""
    counts = {state: sum(c.state == state for c in result.captures) for state in _COLOUR}
    text = ", ".join(f"[{_COLOUR[state]}]{count} {state}[/]" for state, count in counts.items() if count)
    if result.unchanged:
        say("nothing to do: kept from the earlier run")
    open_console().print(
        f"{text} of {len(result.captures)}; {result.out / 'summary.csv'}", soft_wrap=True, highlight=False
    )
