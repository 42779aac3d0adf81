"""What several installed packages bring is said before the work."""

import importlib.metadata
import time

import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.options import ProjectOptions, ReconstructOptions
from colmap_inertial.run.commands.reconstruct import reconstruct
from colmap_inertial.run.commands.reconstruct_project import reconstruct_project
from colmap_inertial.run.preparation import packages


@pytest.fixture
def there(monkeypatch):
    """Sets which distributions are installed."""

    def set_to(**versions):
        known = {name.replace("_", "-"): version for name, version in versions.items()}

        def version(name):
            if name not in known:
                raise importlib.metadata.PackageNotFoundError(name)
            return known[name]

        monkeypatch.setattr(packages.importlib.metadata, "version", version)

    return set_to


def test_one_package_for_each_module_is_silent(there):
    there(pycolmap="4.0.0", opencv_contrib_python_headless="4.13.0.90")
    assert packages.find_conflicts() == []
    there(pycolmap_cuda12="4.0.0", opencv_python="4.10.0.84")
    assert packages.find_conflicts() == []


def test_two_packages_that_bring_one_module_are_named_with_what_to_do(there, caplog):
    there(
        pycolmap="4.0.0", pycolmap_cuda12="4.1.0", opencv_contrib_python_headless="4.13.0.90", opencv_python="4.10.0.84"
    )
    packages.warn_of_conflicts()
    first, second = (record.getMessage() for record in caplog.records)
    assert first == (
        "pycolmap 4.0.0 and pycolmap-cuda12 4.1.0 are installed, and each provides the module pycolmap: the files of "
        "the last one overwrote the others'; keep one of them: pip uninstall pycolmap pycolmap-cuda12; pip install "
        "pycolmap-cuda12"
    )
    assert second.endswith(
        "pip uninstall opencv-contrib-python-headless opencv-python; pip install opencv-contrib-python-headless"
    )


def test_reconstruct_says_so_first(there, caplog, tmp_path):
    there(pycolmap="4.0.0", pycolmap_cuda12="4.0.0")
    with pytest.raises(FormatError):
        reconstruct(tmp_path / "none", tmp_path / "out")
    assert "pip install pycolmap-cuda12" in caplog.text
    caplog.clear()
    with pytest.raises(FormatError):
        reconstruct_project(tmp_path / "none", tmp_path / "out", ProjectOptions(), ReconstructOptions())
    assert "pip install pycolmap-cuda12" in caplog.text


def test_looking_costs_next_to_nothing():
    start = time.perf_counter()
    packages.find_conflicts()
    assert time.perf_counter() - start < 0.5
