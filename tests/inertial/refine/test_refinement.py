"""What decides whether a refinement is believed, and what is told of it: against counts and closed forms."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from colmap_inertial.core.geometry import so3_exp, so3_log
from colmap_inertial.inertial.refine import _residuals, refinement, world
from colmap_inertial.inertial.refine.motion import ImageDrift
from tests.helpers.cases import loop_over


def test_the_size_of_a_path_and_its_derivative():
    angle = 2 * np.pi * np.arange(12) / 12
    ring = 3.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) + [5, 6, 7]
    assert world.size_of(ring) == pytest.approx(3.0)
    rng = np.random.default_rng(0)
    centres, part, step = rng.standard_normal((9, 3)), np.array([2, 3, 5, 8]), 1e-6
    by = world.derive_log_size(centres, part)
    for i in range(9):
        for axis in range(3):
            sizes = []
            for sign in (1, -1):
                moved = centres.copy()
                moved[i, axis] += sign * step
                sizes.append(np.log(world.size_of(moved[part])))
            assert by[i, axis] == pytest.approx((sizes[0] - sizes[1]) / (2 * step), abs=1e-8)
    assert not world.derive_log_size(centres, part[:1]).any()
    assert np.isfinite(world.derive_log_size(np.zeros((3, 3)), np.arange(3))).all()


def test_pictures_alone_hold_a_path_s_farthest_frame_as_far_away_as_it_was():
    path = np.array([[1.0, 2, 3], [4, 3, 3], [-8, -1, 2], [2, 2, 2]])
    axes = np.tile(np.eye(3), (4, 1, 1))
    mean = SimpleNamespace(imu_in_world_m=path, world_from_imu=axes)
    problem = SimpleNamespace(inertial=None, prior=SimpleNamespace(mean=mean))

    def squares(moved):
        x = SimpleNamespace(imu_in_world_m=moved, velocity_m_s=np.zeros((4, 3)), world_from_imu=axes)
        return float(np.sum(_residuals.state_rows(problem, x).residual ** 2))

    assert squares(path) == 0
    away = path - path[0]
    # longer by a millimetre at the farthest frame, where a hundredth of one is held
    longer = path[0] + (1 + 1e-3 / np.linalg.norm(away[2])) * away
    assert squares(longer) == pytest.approx(1e4, rel=1e-3)
    assert squares(path[0] + away @ so3_exp(np.array([0, 0, 1e-4])).T) < 0.01
    others = path.copy()
    others[[1, 3]] += 0.1
    assert squares(others) < 0.01


def test_a_motion_errs_by_its_drift_and_by_what_a_wrong_scale_and_up_do_to_all_of_it():
    rng, count, step = np.random.default_rng(2), 3, 1e-6
    centres, velocities = rng.standard_normal((2, count, 3))
    roots = 0.1 * rng.standard_normal((count, 6, 6))
    similarity, local = 0.1 * rng.standard_normal((7, 7)), 0.1 * rng.standard_normal((count, 3, 3))
    names = tuple(map(str, range(count)))
    drift = ImageDrift(names=names, cam_in_world=centres, cov=roots @ roots.transpose(0, 2, 1))
    found = drift.motion_covs(similarity @ similarity.T, velocities, local @ local.transpose(0, 2, 1))

    def motion(k, error):
        """Position against the first frame's, velocity and rotation, with errors of drift, scale and up."""
        scale, up, turn = np.exp(error[6]), error[7:], error[3:6]
        rotation = so3_exp(up) @ so3_exp(turn)
        position = scale * so3_exp(up) @ (centres[k] - centres[0]) + error[:3]
        return np.concatenate([position, scale * rotation @ velocities[k], so3_log(rotation)])

    for k in range(count):
        by = np.array([motion(k, e) - motion(k, -e) for e in step * np.eye(10)]).T / (2 * step)
        cov = by[:, :6] @ drift.cov[k] @ by[:, :6].T + by[:, 6:] @ (similarity @ similarity.T)[:4, :4] @ by[:, 6:].T
        cov[3:6, 3:6] += local[k] @ local[k].T
        assert found[k] == pytest.approx(cov, rel=1e-6, abs=1e-9)


def test_errors_in_pixels_are_roots_of_mean_costs():
    assert refinement._convert_cost_to_px(np.array([1.0, 4.0, 7.0]), 0.5) == pytest.approx(1.0)
    assert refinement._convert_cost_to_px(np.zeros(0), 0.5) == 0.0


@loop_over(
    ("links", "nodes", "expected"),
    # nine residuals of a link; three velocities of each node that it touches are unknown
    [(10, 11, 57), (1, 2, 3), (0, 0, 1), (2, 6, 1)],
)
def test_what_the_imu_adds_is_counted(links, nodes, expected):
    flags = [np.arange(20) < count for count in (links, nodes)]
    inertial = SimpleNamespace(linked=flags[0], touched=flags[1])
    assert refinement._count_freedom(SimpleNamespace(inertial=inertial)) == expected


@loop_over(
    ("alone", "seen", "chi2", "change", "code"),
    [
        (True, True, 3.0, -0.1, None),
        (True, True, 3.01, -0.1, "imu-contradicts-images"),
        (True, True, 1.0, -0.011, None),
        (True, True, 1.0, -0.01, "refinement-no-better"),
        (False, True, 1.0, -0.1, "pictures-not-converged"),
        (True, False, 9.0, -0.1, "refinement-not-converged"),
    ],
)
def test_a_refinement_is_doubted(alone, seen, chi2, change, code):
    solutions = [SimpleNamespace(converged=rests) for rests in (alone, seen)]
    doubt = refinement._find_doubt(*solutions, chi2, change, 0.01)
    assert (None if doubt is None else doubt.code) == code


@loop_over(
    ("offset_s", "clock_rate", "readout_s", "refused"),
    # readings reach 50 ms from each of the frames from -20 to 30 s
    [
        (0.049, 0.0, 0.0, False),
        (0.051, 0.0, 0.0, True),
        (-0.051, 0.0, 0.0, True),
        (0.039, 0.0, 0.020, False),
        (0.041, 0.0, 0.020, True),
        (0.041, 0.0, -0.020, True),
        (0.019, 1e-3, 0.0, False),
        (0.021, 1e-3, 0.0, True),
        (-0.021, 1e-3, 0.0, False),
        (-0.031, 1e-3, 0.0, True),
    ],
)
def test_clocks_are_too_far_apart_where_readings_do_not_reach(offset_s, clock_rate, readout_s, refused):
    inertial = SimpleNamespace(
        nodes_s=np.array([0.0, 80.0, 110.0, 130.0, 500.0]),
        touched=np.array([False, True, True, True, False]),
        middle_s=100.0,
        turning=SimpleNamespace(half_span_s=0.05),
    )
    x = SimpleNamespace(offset_s=offset_s, clock_rate=clock_rate, readout_s=readout_s)
    assert bool(refinement._find_late_clock(SimpleNamespace(inertial=inertial), x)) == refused


def test_every_tenth_of_points_that_are_seen_often_is_held_out():
    lengths = np.array([3, 4, 5, 2, 30, 4, 3, 25])
    first = np.concatenate([[0], np.cumsum(lengths)])
    point = np.repeat(np.arange(8), lengths)
    observations = SimpleNamespace(first=first, point=point, frame=np.zeros(len(point)))
    often = [m for m in range(len(point)) if lengths[point[m]] >= 4]
    assert np.flatnonzero(refinement._choose_held_out(observations)).tolist() == often[5::10]


def test_a_sigma_of_the_readout_is_that_of_its_column(monkeypatch):
    cov = np.diag(np.arange(1.0, 41.0)) * 1e-6
    monkeypatch.setattr(refinement, "factor_information", lambda problem, x: SimpleNamespace(shared_cov=lambda: cov))
    found = refinement._estimate_readout(SimpleNamespace(), SimpleNamespace(readout_s=0.02))
    assert found == (0.02, pytest.approx(np.sqrt(1e-6 * (refinement.READOUT + 1))))

    def singular(problem, x):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(refinement, "factor_information", singular)
    assert refinement._estimate_readout(SimpleNamespace(), SimpleNamespace(readout_s=0.02)) is None


def test_noise_that_cannot_be_measured_stays_as_it_was(monkeypatch):
    def singular(problem, x):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(refinement, "apply_measured_noise", singular)
    monkeypatch.setattr(refinement, "measure_shared_errors", lambda problem, x: 4.0)
    monkeypatch.setattr(refinement, "_select_observations", lambda problem, keep: problem)
    problem = Pixels(inertial=1, shared_errors=1.0)
    assert refinement._measure_noise(problem, np.ones(3, dtype=bool), None) == Pixels(inertial=1, shared_errors=4.0)


@dataclass(frozen=True)
class Pixels:
    """Of a problem, what noise changes."""

    inertial: int
    shared_errors: float


def test_frames_whose_observations_change_together_are_one_each():
    rng = np.random.default_rng(0)
    frame = rng.permutation(np.repeat(np.arange(0, 400, 2), 30))
    by_frame, own = rng.normal(-0.1, 0.3, 400), rng.normal(0.0, 0.5, len(frame))
    for together, sigma in ((0.0, 0.5 / 6000**0.5), (1.0, (0.3**2 / 200 + 0.5**2 / 6000) ** 0.5)):
        change, found = refinement._average_change(np.ones(6000), 1 + together * by_frame[frame] + own, frame)
        assert found == pytest.approx(sigma, rel=0.15)
        assert abs(change + 0.1 * together) < 4 * sigma
    assert refinement._average_change(np.ones(9), np.zeros(9), np.full(9, 3)) == (-1.0, np.inf)
    assert refinement._average_change(np.ones(0), np.ones(0), frame[:0]) == (0.0, np.inf)
