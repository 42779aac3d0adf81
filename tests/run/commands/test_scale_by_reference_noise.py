"""How sure a scale by a known distance or a target is: against scatter, and against what was measured."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError
from colmap_inertial.core.facts import Fact
from colmap_inertial.core.options import ReferenceOptions
from colmap_inertial.run.commands import scale_by_reference as reference
from colmap_inertial.run.commands.scale_by_reference import scale_by_distance, scale_by_target
from tests.helpers.markers_in_model import validated

BETWEEN = ReferenceOptions(target="aruco:DICT_4X4_50:0.1", between=("0", "1"), distance="2.0+-0.01")


def noisy(validation, sigma, rng):
    """The validation with noise on each corner, model units."""
    corners = [replace(one, in_model=one.in_model + sigma * rng.standard_normal(3)) for one in validation.corners]
    return replace(validation, corners=tuple(corners))


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_the_scale_by_two_markers_scatters_as_it_says(scale):
    """Places of markers are off by what their corners tell; the distance itself is as sure as its owner says."""
    rng = np.random.default_rng(6)
    exact, sigma = validated(scale, unscaled=True), 0.02 / scale
    found = [scale_by_distance(BETWEEN, noisy(exact, sigma, rng)) for _ in range(2500)]
    scales = np.exp([one.log_scale for one, _ in found])
    sigmas = np.array([one.sigma for one, _ in found])
    assert np.median(scales) == pytest.approx(scale, rel=2e-3)
    # the length that was given was the same each time
    of_markers = np.sqrt(np.mean(sigmas**2 - 0.005**2))
    assert np.std(np.log(scales)) == pytest.approx(of_markers, rel=0.06)
    # the centre of a marker is a mean of four corners, and two centres make the distance of 2 m
    assert of_markers == pytest.approx(np.sqrt(2) * 0.02 / 2 / 2.0, rel=0.03)


def test_points_are_exact_and_leave_what_the_distance_has():
    given = ReferenceOptions(between=("1,2,3", "4,6,3"), distance="2.0+-0.03")
    evidence, _ = scale_by_distance(given, None)
    assert evidence.metres_per_unit == pytest.approx(2.0 / 5.0) and evidence.sigma == pytest.approx(0.015)


def test_an_interval_of_a_target_is_that_of_the_measurement():
    exact = replace(validated(0.5, unscaled=True), metres_per_unit_ci95=(0.48, 0.52))
    evidence, _ = scale_by_target(exact)
    assert evidence.metres_per_unit == pytest.approx(0.5) and evidence.sigma == pytest.approx(
        np.log(0.52 / 0.48) / 2 / 1.96, rel=1e-4
    )
    half = replace(exact, control=SimpleNamespace(metres_per_unit=0.6, ci95=(0.57, 0.63)))
    evidence, _ = scale_by_target(half)
    assert evidence.metres_per_unit == pytest.approx(0.6) and evidence.sigma == pytest.approx(
        np.log(0.63 / 0.57) / 2 / 1.96, rel=1e-4
    )


@pytest.mark.parametrize(("check_error_pct", "told"), [(None, False), (1.25, True)])
def test_the_interval_that_is_written_has_that_width(tmp_path, monkeypatch, check_error_pct, told):
    measured = replace(
        validated(0.5, unscaled=True), metres_per_unit_ci95=(0.48, 0.52), check_error_pct=check_error_pct
    )
    applied = []
    monkeypatch.setattr(reference, "only_model", lambda folder: folder)
    monkeypatch.setattr(reference, "validate_model", lambda *_, **__: measured)
    monkeypatch.setattr(reference, "apply_to_project", lambda *args, **_: applied.append(args[2]))
    monkeypatch.setattr(reference, "write_json", lambda *_: None)
    (tmp_path / "images").mkdir()
    options = ReferenceOptions(target="aruco:DICT_4X4_50:0.1")
    found = reference.scale_project_by(tmp_path, tmp_path / "out", options, scale_from=("target",))
    low, high = found.sensors.ci95
    assert low < 0.5 < high and low * high == pytest.approx(0.25) and high / low == pytest.approx(0.52 / 0.48)
    assert any("+1.2 % off" in str(note) for note in found.notes) == told


def test_a_target_needs_the_project_s_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(reference, "only_model", lambda folder: folder)
    options = ReferenceOptions(target="aruco:DICT_4X4_50:0.1")
    with pytest.raises(FormatError, match=r"images.*give the project's images with --images DIR"):
        reference.scale_project_by(tmp_path, tmp_path / "out", options)


def test_the_model_lies_in_sparse_or_is_the_folder_itself(tmp_path, monkeypatch):
    asked = []

    def look(folder):
        asked.append(folder)
        raise FormatError(folder, Fact.stated("seen"))

    monkeypatch.setattr(reference, "only_model", look)
    known = ReferenceOptions(between=("1,2,3", "4,6,3"), distance="2.0+-0.03")
    for _ in range(2):
        with pytest.raises(FormatError, match="seen"):
            reference.scale_project_by(tmp_path, tmp_path / "out", known)
        (tmp_path / "sparse").mkdir(exist_ok=True)
    assert asked == [tmp_path, tmp_path / "sparse"]
