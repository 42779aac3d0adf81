"""Limits of a process."""

import pytest

from colmap_inertial.cli import process
from colmap_inertial.core.errors import InertialError


@pytest.mark.parametrize("fewer", [False, True])
def test_less_memory_than_libraries_need_is_said(monkeypatch, fewer):
    resource = pytest.importorskip("resource")
    unlimited = (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE)
    least = process.LEAST_BYTES + process.THREAD_BYTES
    monkeypatch.setattr("colmap_inertial.core.threads.usable_processors", lambda: 1)
    limits = {resource.RLIMIT_AS: least - fewer} | dict.fromkeys(unlimited, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits[kind], limits[kind]))
    if not fewer:
        assert process.require_limits(to_load=False) is None
    else:
        with pytest.raises(InertialError, match="of memory are allowed to a process here"):
            process.require_limits(to_load=False)
