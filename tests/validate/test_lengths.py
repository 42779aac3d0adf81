"""What a check proves: length errors, scale bars, check points, the target's own uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_inertial.core.errors import FormatError, InertialError, NotObservableError
from colmap_inertial.core.geometry import quat_exp, quat_rotate
from colmap_inertial.core.options import ValidateOptions
from colmap_inertial.run.commands.validate import KnownLengths, validate_source
from colmap_inertial.validate import (
    Corner,
    Distance,
    TargetSpecError,
    add_bars,
    add_other_target,
    parse_target,
)
from colmap_inertial.validate.markers import add_check_points, distance_between
from colmap_inertial.validate.result import check_lengths, model_diagonal
from tests.helpers.cases import loop_over
from tests.helpers.markers_in_model import PLACES, validated


def test_a_scale_bar_is_measured_between_centres(tmp_path):
    table = tmp_path / "bars.csv"
    table.write_text("marker_a,marker_b,length_m,sigma_m\n0,1,2.001,0.0002\n1,3,3.2,\n")
    first, second = add_bars(validated(), table).bars
    assert first.measured == pytest.approx(2) and first.residual_m == pytest.approx(-0.001)
    assert (first.markers, first.sigma_m, second.sigma_m) == ((0, 1), 0.0002, None)
    (first, _) = add_bars(validated(0.25, unscaled=True), table).bars
    assert first.measured == pytest.approx(8) and first.residual_m == pytest.approx(-0.001)


@loop_over(
    ("text", "words"),
    [
        ("a,b\n1,2\n", "has no column marker_a"),
        (
            "marker_a,marker_b,length_m\n0,9,2\n",
            "line 2: marker 9 was not measured in the model; those that were: 0, 1",
        ),
        ("marker_a,marker_b,length_m\n0,1,two\n", 'length_m is "two", not a number'),
        ("marker_a,marker_b,length_m\n0,1,-2\n", "must be positive"),
    ],
)
def test_a_table_of_bars_that_cannot_be_used_says_where(tmp_path, text, words):
    table = tmp_path / "bars.csv"
    table.write_text(text)
    with pytest.raises(FormatError, match=words):
        add_bars(validated(), table)


def test_check_points_leave_the_models_own_error(tmp_path):
    table = tmp_path / "points.csv"
    rows = [f"{number},{10 + x},{20 + y},{z},0.002" for number, (x, y, z) in PLACES.items()]
    table.write_text("\n".join(["marker,x,y,z,sigma_m", *rows]) + "\n")
    exact = add_check_points(validated(), table).check_points
    np.testing.assert_allclose(exact.rmse_m, 0, atol=1e-9)
    assert exact.rmse_vertical_m == pytest.approx(0.002) and exact.rmse_horizontal_m == pytest.approx(0.002 * 2**0.5)
    off = add_check_points(validated(error_m=0.05), table).check_points
    worst = max(off.points, key=lambda point: np.linalg.norm(point.residual_m))
    assert worst.marker == 3 and 0.01 < off.rmse_vertical_m < 0.05
    table.write_text("\n".join(["marker,x,y,z", *rows[:3]]).replace(",0.002", "") + "\n")
    with pytest.raises(NotObservableError, match="3 check points; 4"):
        add_check_points(validated(), table)


def board(spec, middle, scale=1.0, *, left_out=()):
    """A board around a place in metres, in a model whose unit is 1/scale metres."""
    target = parse_target(spec)
    at = quat_rotate(quat_exp(np.array([0.3, -0.2, 0.5])), target.corners_m) + middle
    corners = [Corner(name=target.label(i), in_model=place / scale) for i, place in enumerate(at) if i not in left_out]
    return replace(validated(scale), target=target, corners=tuple(corners))


def test_the_distance_between_two_boards_is_a_length_to_check_by():
    first = board("checkerboard:8x6:0.03", [0.2, 0.1, 0.0], left_out=range(9))
    other = board("checkerboard:9x6:0.05", [0.2, 4.1, 3.0], left_out=(0, 1, 2))
    apart = add_other_target(first, other, 5.01, 0.002).apart
    assert (apart.other, apart.known_m, apart.sigma_m) == ("checkerboard:9x6:0.05", 5.01, 0.002)
    assert apart.measured == pytest.approx(5) and apart.residual_m == pytest.approx(-0.01)
    unscaled = replace(board("checkerboard:8x6:0.03", [0.2, 0.1, 0.0], 0.5), unscaled=True)
    assert add_other_target(unscaled, board("checkerboard:9x6:0.05", [0.2, 4.1, 3.0], 0.5), 5.0).apart.measured == 10
    with pytest.raises(NotObservableError, match="too few corners of checkerboard:8x6"):
        add_other_target(board("checkerboard:8x6:0.03", [0, 0, 0], left_out=range(3, 48)), other, 5.0)


@loop_over(
    ("target", "other", "words"),
    [
        ("checkerboard:8x6:0.03", ("checkerboard:8x6:0.03", "4"), "must differ from --target"),
        ("aruco:DICT_4X4_50:0.1", ("checkerboard:8x6:0.03", "4"), "go into --bars"),
        ("checkerboard:8x6:0.03", ("checkerboard:9x6:0.03", "four"), "write metres between"),
        ("checkerboard:8x6:0.03", ("checkerboard:9x6:0.03", "4+-5"), "write metres between"),
    ],
)
def test_a_second_board_that_cannot_be_used_is_refused_before_the_search(tmp_path, target, other, words):
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("")
    with pytest.raises(InertialError, match=words):
        validate_source(tmp_path, tmp_path, target, ValidateOptions(), known=KnownLengths(other=other))


def test_the_distance_of_two_markers():
    assert distance_between(validated(0.5), 0, 1) == pytest.approx(4)
    with pytest.raises(NotObservableError, match="marker 8 was not measured"):
        distance_between(validated(), 0, 8)


def lengths_of(ends, diagonal):
    ends = np.array(ends, dtype=float)
    corners = tuple(Corner(name=f"{i}{j}", in_model=p) for i, pair in enumerate(ends) for j, p in enumerate(pair))
    known = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    distances = [
        Distance(pair=(f"{i}0", f"{i}1"), known_m=length, measured=length, residual_m=error, set="check")
        for i, (length, error) in enumerate(zip(known, (0.001, -0.002, 0.003), strict=False))
    ]  # fmt: skip
    return check_lengths(distances, corners, diagonal, 1.0)


def test_lengths_are_summed_up_and_what_they_prove_is_said():
    board = [[(0, 0, 0), (0.5, 0, 0)], [(0, 0, 0), (0, 0.3, 0)]]
    found = lengths_of(board, 50.0)
    assert (found.count, found.directions, found.longest_m) == (2, 2, 0.5)
    assert found.rms_m == pytest.approx(np.sqrt((1e-6 + 4e-6) / 2)) and found.largest_m == pytest.approx(-0.002)
    assert found.longest_share == pytest.approx(0.01)
    assert "1 % of the model's diagonal of 50 m" in str(found.proves)
    assert found.proves.values["shows_elsewhere"] == "nothing"
    whole = lengths_of([*board, [(0, 0, 0), (0, 0, 0.6)]], 0.8)
    assert whole.directions == 3 and "over 75 % of the model's diagonal" in str(whole.proves)
    assert check_lengths([], [], 1.0, 1.0) is None
    assert model_diagonal(np.zeros((1, 3))) is None


def test_a_target_says_how_well_it_is_known():
    target = parse_target("checkerboard:9x6:0.025+-0.0001")
    assert (target.length_m, target.sigma_m, target.spec) == (0.025, 0.0001, "checkerboard:9x6:0.025+-0.0001")
    tags = parse_target("aprilgrid:6x6:0.088+-0.0002:0.3")
    assert (tags.length_m, tags.gap, tags.sigma_m) == (0.088, 0.3, 0.0002)
    assert parse_target("checkerboard:9x6:0.025").sigma_m is None
    for spec in ("checkerboard:9x6:0.025+-x", "checkerboard:9x6:0.025+-0.02", "aprilgrid:6x6:0.088:0.3+-0.01"):
        with pytest.raises(TargetSpecError):
            parse_target(spec)
