"""Fixtures shared by all tests."""

import gc
import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from colmap_inertial.core.threads import one_blas_thread
from colmap_inertial.tools.simulate import MotionOptions, RecordingOptions, simulate_recording
from tests.helpers.simulated_project import Project, write_project

TESTS = Path(__file__).parent

#: Files of the quick tier, relative to this folder: each takes a few seconds at most.
QUICK = (TESTS / "quick.txt").read_text().split()

#: Files that take longest, the longest first: a worker that is handed one of them last keeps the others waiting.
SLOW = (TESTS / "slow.txt").read_text().split()


# What is imported and collected stays to the end: nobody needs to look through it for garbage again and again.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="only the files named in tests/quick.txt")
    parser.addoption("--no-skips", action="store_true", help="a test that would be skipped fails")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    outcome = yield
    _fail_skipped(item.config, outcome.get_result())


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    outcome = yield
    _fail_skipped(collector.config, outcome.get_result())


def _fail_skipped(config: pytest.Config, report: pytest.TestReport | pytest.CollectReport) -> None:
    if config.getoption("--no-skips") and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome, report.longrepr = "failed", f"skipped, which --no-skips does not allow: {reason}"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    if config.getoption("--quick") and collection_path.suffix == ".py":
        return _listed_name(collection_path) not in QUICK or None
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not hasattr(config, "workerinput"):
        return  # one process runs tests in the order in which they are named
    place = {name: i for i, name in enumerate(SLOW)}
    items.sort(key=lambda item: place.get(_listed_name(item.path), len(place)))


def _listed_name(path: Path) -> str:
    """A test file as ``quick.txt`` and ``slow.txt`` name it."""
    return path.relative_to(TESTS).as_posix() if path.is_relative_to(TESTS) else path.name


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    """As the package's own entry points have it; tests also call what lies below them."""
    with one_blas_thread():
        yield


def _once(measure: Callable) -> Callable:
    """``measure`` of frames, a camera, their timing and options, which keeps what it found."""
    measured = {}

    def measure_once(frames, camera, timing, *options):
        frames = list(frames)
        exposure_s = None if timing.exposure_s is None else timing.exposure_s.tolist()
        told = (timing.names, timing.t_s.tolist(), exposure_s, timing.readout_s, timing.readout_direction)
        known = (camera.model, camera.params.tolist(), told, timing.epoch_ns, options)
        seen = hashlib.sha256(repr(known).encode())
        for frame in frames:
            seen.update(f"{frame.name} {frame.width} {frame.grey.shape}".encode() + frame.grey.tobytes())
        if seen.digest() not in measured:
            measured[seen.digest()] = measure(frames, camera, timing, *options)
        return measured[seen.digest()]

    return measure_once


@pytest.fixture(scope="session", autouse=True)
def _pictures_are_compared_once():
    """Many tests reconstruct the same capture: what is measured in its pictures beforehand is kept."""
    from colmap_inertial.run.preparation import preflight, sampling

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preflight, "measure_two_view_rotations", _once(preflight.measure_two_view_rotations))
        patch.setattr(sampling, "measure_rotation", _once(sampling.measure_rotation))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk():
    """Nothing that a test writes has to outlast a power cut, and tests that write many files wait mostly for that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


class _Errors(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(logging.Formatter().format(record))


@pytest.fixture(scope="session")
def report_failures():
    """What went wrong with reports, which a run survives; a test that means it to happen empties the list."""
    handler = _Errors()
    logger = logging.getLogger("colmap_inertial.run.commands.reporting")
    logger.addHandler(handler)
    yield handler.messages
    logger.removeHandler(handler)


@pytest.fixture(autouse=True)
def _no_report_fails(report_failures: list[str]):
    yield
    found = report_failures.copy()
    report_failures.clear()
    assert not found, "\n".join(found)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings beside the checkout; they are not part of the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not beside this checkout ({folder.name} folder absent)")
    return folder


@pytest.fixture(scope="session")
def project(tmp_path_factory) -> Project:
    """A handheld recording of 20 s, its clocks hundreds of seconds apart, as files. Tests must not change it."""
    options = RecordingOptions(motion=MotionOptions(duration_s=20.0))
    return write_project(tmp_path_factory.mktemp("project"), simulate_recording(options, seed=11))
