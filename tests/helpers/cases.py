"""Many quick cases in one test: a loop that runs all of them and names those that failed."""

import functools
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest


def loop_over(
    names: str | tuple[str, ...], cases: Iterable[Any], ids: Callable[[Any], str] | Iterable[str] | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for each case, as ``pytest.mark.parametrize`` does, but as one test.

    For cases of milliseconds. All run, whatever fails; the errors come as one group, each with its case. A case has its
    own folder as ``tmp_path``, its own ``monkeypatch``, and an empty ``capsys``; other fixtures are shared.
    """
    arguments = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    values = [(case,) if len(arguments) == 1 else tuple(case) for case in cases]
    if ids is None:
        labels = [", ".join(str(value)[:60] for value in case) for case in values]
    elif callable(ids):
        labels = [", ".join(ids(value) for value in case) for case in values]
    else:
        labels = list(ids)
    assert values and len(labels) == len(values) and all(len(case) == len(arguments) for case in values)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(test)

        @functools.wraps(test)
        def run_cases(**fixtures: Any) -> None:
            errors: list[BaseException] = []
            for number, (label, case) in enumerate(zip(labels, values, strict=True)):
                try:
                    _run_case(test, number, fixtures, dict(zip(arguments, case, strict=True)))
                except (Exception, pytest.fail.Exception) as error:
                    error.add_note(f"case {label}")
                    errors.append(error)
            if errors:
                raise BaseExceptionGroup(f"{len(errors)} of {len(values)} cases failed", errors)

        fixtures = [parameter for name, parameter in signature.parameters.items() if name not in arguments]
        run_cases.__signature__ = signature.replace(parameters=fixtures)  # type: ignore[attr-defined]
        return run_cases

    return decorate


def _run_case(test: Callable[..., None], number: int, fixtures: dict[str, Any], case: dict[str, Any]) -> None:
    own = dict(fixtures)
    if isinstance(folder := own.get("tmp_path"), Path):
        own["tmp_path"] = folder / f"case{number}"
        own["tmp_path"].mkdir()
    if "capsys" in own:
        own["capsys"].readouterr()
    if "monkeypatch" not in own:
        test(**own, **case)
        return
    with pytest.MonkeyPatch.context() as own["monkeypatch"]:
        test(**own, **case)
