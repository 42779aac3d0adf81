"""The compiled linear algebra and integration of the estimators against their plain counterparts."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.special import chdtrc

from colmap_inertial._kernels import _inertial
from colmap_inertial.inertial.core.arrow import ArrowSystem
from colmap_inertial.inertial.core.preintegration import (
    Preintegrated,
    SensorErrors,
    SensorStream,
    SensorStreams,
    preintegrate,
)
from colmap_inertial.inertial.scale._fit import chi2_tail
from colmap_inertial.motion.align import _fit as align_fit
from tests.references.scale import add_reference, preintegrate_reference, solve_reference

SIZES = [(1, 21, 79, 1), (2, 21, 79, 5), (3, 21, 79, 5), (3, 5, 4, 2), (2, 7, 0, 3), (40, 1, 1, 9), (480, 21, 79, 5)]


def random_system(rng, states: int, size: int, n_globals: int) -> ArrowSystem:
    """Normal equations of random residuals between neighbours, of numbers of very different sizes."""
    system = ArrowSystem.zeros(states, size, n_globals)
    scales, global_scales = 10.0 ** rng.uniform(-3, 3, size), 10.0 ** rng.uniform(-3, 3, n_globals)
    rows = 2 * size + n_globals
    for k in range(states):
        here, after = rng.standard_normal((2, rows, size)) * scales
        z = rng.standard_normal((rows, n_globals)) * global_scales
        system.diagonal[k] += here.T @ here
        system.border[k] += here.T @ z
        system.corner += z.T @ z
        if k + 1 < states:
            system.diagonal[k + 1] += after.T @ after
            system.below[k] += after.T @ here
            system.border[k + 1] += after.T @ z
    return system


def with_sides(rng, states: int, size: int, n_globals: int, sides: int):
    system = random_system(rng, states, size, n_globals)
    return system, rng.standard_normal((states, size, sides)), rng.standard_normal((n_globals, sides))


def close(value, truth, tolerance: float = 1e-9) -> bool:
    return value.shape == truth.shape and np.allclose(
        value, truth, rtol=0, atol=tolerance * np.max(np.abs(truth), initial=0.0)
    )


def test_arrow_systems_are_solved_as_by_lapack(subtests):
    for sizes in SIZES:
        with subtests.test(sizes=sizes):
            system, rhs, rhs_z = with_sides(np.random.default_rng(0), *sizes)
            unit = np.sqrt(np.diagonal(system.diagonal, axis1=1, axis2=2))[:, :, None]
            states, z, cov = system.solve(rhs, rhs_z)
            states_truth, z_truth, cov_truth = solve_reference(system, rhs, rhs_z)
            assert close(states * unit, states_truth * unit)
            assert close(z, z_truth) and close(cov, cov_truth)


def test_every_instruction_set_eliminates_and_substitutes_alike(subtests):
    for instruction_set in _inertial.instruction_sets():
        for sizes in ((30, 21, 79, 5), (9, 5, 4, 2), (8, 13, 20, 3)):
            with subtests.test(instruction_set=instruction_set, sizes=sizes):
                k, m, n, q = sizes
                system, rhs, _ = with_sides(np.random.default_rng(1), *sizes)
                unit = 1 / np.sqrt(np.diagonal(system.diagonal, axis1=1, axis2=2))
                dense = np.zeros((k, m, k, m))
                for i in range(k):
                    dense[i, :, i] = system.diagonal[i]
                    if i + 1 < k:
                        dense[i + 1, :, i] = system.below[i]
                        dense[i, :, i + 1] = system.below[i].T
                dense = (dense * unit[:, :, None, None] * unit).reshape(k * m, k * m)
                border = (system.border * unit[:, :, None]).reshape(k * m, n)
                scaled = (rhs * unit[:, :, None]).reshape(k * m, q)

                products, forward = np.empty((n, n + q)), np.empty((k, m, -(-(n + q) // 8) * 8))
                parts = system.diagonal, system.below, system.border, rhs, unit, products
                factor = _inertial.eliminate(*parts, forward=forward, instruction_set=instruction_set)
                assert factor is not None
                solved = np.linalg.solve(dense, np.hstack([border, scaled]))
                assert close(products, border.T @ solved)
                factor.substitute(forward, half_done=True)
                assert close(forward.reshape(k * m, -1)[:, : n + q], solved)
                with pytest.raises(ValueError, match="padded"):
                    _inertial.eliminate(*parts, forward=np.empty((k, m, n)))
                sides = rhs * unit[:, :, None]
                factor.substitute(sides)
                assert close(sides.reshape(k * m, q), np.linalg.solve(dense, scaled))
                truth = np.linalg.inv(dense).reshape(k, m, k, m)
                here, beside = np.empty((k, m, m)), np.empty((k - 1, m, m))
                factor.selected_inverse(here, beside)
                assert close(here, np.stack([truth[i, :, i] for i in range(k)]))
                assert close(beside, np.stack([truth[i, :, i + 1] for i in range(k - 1)]))
                with pytest.raises(ValueError, match="size of the chain"):
                    factor.selected_inverse(beside, here)


def test_information_of_residuals_is_added_as_by_numpy(subtests):
    for instruction_set in ("", *_inertial.instruction_sets()):
        for rows, with_after, n_globals in ((9, True, 28), (3, False, 79), (3, True, 0), (1, False, 5)):
            with subtests.test(instruction_set=instruction_set, rows=rows, with_after=with_after, n_globals=n_globals):
                rng = np.random.default_rng(8)
                states, size, first, column = 37, 21, 2, 3
                here, after = rng.standard_normal((2, states, rows, size))
                z = rng.standard_normal((states, rows, n_globals)) if n_globals else None
                system, truth = (random_system(np.random.default_rng(9), 40, size, n_globals + 4) for _ in range(2))
                arguments = (here, after if with_after else None, z)
                if instruction_set:
                    blocks = {name: getattr(system, name) for name in ("diagonal", "below", "border", "corner")}
                    _inertial.add_information(
                        *arguments, first=first, column=column, **blocks, instruction_set=instruction_set
                    )
                else:
                    system.add(*arguments, first=first, column=column)
                add_reference(truth, *arguments, first=first, column=column)
                for name in ("diagonal", "below", "border", "corner"):
                    assert close(getattr(system, name), getattr(truth, name), 1e-14), name


def test_residuals_beyond_the_chain_are_rejected():
    system = ArrowSystem.zeros(3, 4, 2)
    here = np.ones((3, 1, 4))
    for after, first, column, z in ((here, 0, 0, None), (None, 1, 0, None), (None, 0, 1, np.ones((3, 1, 2)))):
        with pytest.raises(ValueError, match="beyond"):
            system.add(here, after, z, first=first, column=column)


def test_systems_that_determine_too_little_raise(subtests):
    for solve in (ArrowSystem.solve, solve_reference):
        with subtests.test(solve=solve.__qualname__):
            rng = np.random.default_rng(2)
            for spoil in ("indefinite", "below", "undetermined", "nan", "infinite"):
                system, rhs, rhs_z = with_sides(rng, 3, 4, 2, 1)
                if spoil == "indefinite":
                    system.diagonal[1, 0, 1] = system.diagonal[1, 1, 0] = 2 * np.max(system.diagonal[1])
                elif spoil == "below":
                    system.below[1] *= 1e3
                elif spoil == "undetermined":
                    system.corner[:] = 0
                elif spoil == "nan":
                    system.diagonal[2, 3, 3] = np.nan
                else:
                    system.diagonal[0, 0, 0] = np.inf
                with pytest.raises(np.linalg.LinAlgError):
                    solve(system, rhs, rhs_z)


def test_arrays_of_the_wrong_size_are_rejected():
    system, rhs, _ = with_sides(np.random.default_rng(3), 3, 4, 2, 1)
    unit, products = np.ones((3, 4)), np.empty((2, 3))
    for wrong in ({"below": system.below[:1]}, {"rhs": rhs[:2]}, {"products": products[:1]}):
        arguments = {
            "diagonal": system.diagonal, "below": system.below, "border": system.border, "rhs": rhs, "unit": unit,
            "products": products, **wrong,
        }  # fmt: skip
        with pytest.raises(ValueError, match="not"):
            _inertial.eliminate(**arguments)


def streams(rng, t_s):
    gyro = np.cumsum(rng.standard_normal((len(t_s), 3)), axis=0) * 0.1
    accel = rng.standard_normal((len(t_s), 3)) + np.array([0, 0, 9.8])
    return SensorStream.from_samples(t_s, gyro), SensorStream.from_samples(t_s + 0.0013, accel)


def test_intervals_are_integrated_as_by_numpy(subtests):
    for case in ("real size", "one interval", "beyond the samples", "gaps", "slow", "at rest"):
        with subtests.test(case=case):
            rng = np.random.default_rng(4)
            t_s = (
                np.sort(rng.uniform(0, 60, 6000))
                if case == "real size"
                else np.arange(0, 60, 0.05 if case == "slow" else 0.01)
            )
            if case == "gaps":
                t_s = np.concatenate([t_s[:1000], t_s[1012:2000], t_s[2400:]])
            nodes_s = np.sort(rng.uniform(0.5, 59.5, 481))
            if case == "one interval":
                nodes_s = nodes_s[100:102]
            if case == "beyond the samples":
                nodes_s = np.linspace(-1, 62, 500)
            gyro, accel = streams(rng, t_s)
            k = len(nodes_s) - 1
            arguments = {
                "gyro_bias_rad_s": 0.02 * rng.standard_normal((k, 3)),
                "accel_bias_m_s2": 0.2 * rng.standard_normal((k, 3)),
                "gyro_gain": 0.01 * rng.standard_normal((3, 3)),
                "accel_gain": 0.01 * rng.standard_normal((3, 3)),
                "accel_delay_s": 0.013,
            }
            if case == "at rest":
                gyro = SensorStream.from_samples(t_s, np.zeros((len(t_s), 3)))
                arguments["gyro_bias_rad_s"][:] = 0
            both, errors = SensorStreams(gyro=gyro, accel=accel), SensorErrors(**arguments)
            fast, truth = preintegrate(nodes_s, both, errors), preintegrate_reference(nodes_s, both, errors)
            assert (np.max(truth.cov_gaps) > 0) == (
                case in ("gaps", "real size", "slow") and np.max(np.diff(t_s)) > 0.06
            )
            for field in fields(Preintegrated):
                assert close(getattr(fast, field.name), getattr(truth, field.name)), field.name


def correlated(rng, count: int, pose: float, rate: float):
    """Residuals with noise of poses that neighbours share, and of the rate."""
    dt_s = rng.uniform(0.03, 0.2, count)
    poses = np.sqrt(pose) * rng.standard_normal((count + 1, 3))
    return np.diff(poses, axis=0) + np.sqrt(rate * dt_s)[:, None] * rng.standard_normal((count, 3)), dt_s


def covariance(dt_s, excess, pose, rate):
    off = -pose * np.eye(len(dt_s), k=1)
    return np.diag((2 * pose + rate * dt_s) * excess) + off + off.T


def test_residuals_are_whitened_as_by_the_dense_factor(subtests):
    for count in (1, 2, 50):
        with subtests.test(count=count):
            rng = np.random.default_rng(5)
            residual, dt_s = correlated(rng, count, 1e-6, 1e-7)
            jacobian, excess = rng.standard_normal((count, 3, 4)), rng.uniform(1, 5, count)
            factor = cholesky(covariance(dt_s, excess, 1e-6, 1e-7), lower=True)
            white, white_jacobian = align_fit._whiten(residual, jacobian, dt_s, excess, (1e-6, 1e-7))
            assert close(white, solve_triangular(factor, residual, lower=True))
            flat = solve_triangular(factor, jacobian.reshape(count, -1), lower=True)
            assert close(white_jacobian, flat.reshape(jacobian.shape))
            half_log_det = align_fit._whiten_sides(residual.copy(), dt_s, excess, (1e-6, 1e-7))
            assert half_log_det == pytest.approx(np.sum(np.log(np.diag(factor))))


def test_a_covariance_that_is_none_is_rejected():
    residual, dt_s = correlated(np.random.default_rng(6), 5, 1e-6, 1e-7)
    with pytest.raises(np.linalg.LinAlgError):
        align_fit._whiten(residual, residual[:, :, None], dt_s, np.full(5, 0.1), (1e-6, 0.0))


def test_noise_levels_are_the_most_likely_ones(subtests):
    for pose, rate in ((1e-6, 1e-7), (1e-8, 1e-5), (1e-5, 1e-10), (1e-13, 1e-7)):
        with subtests.test(pose=pose, rate=rate):
            rng = np.random.default_rng(7)
            residual, dt_s = correlated(rng, 300, pose, rate)
            excess, least_rate = rng.uniform(1, 1.5, 300), 1e-9

            def cost(logs, residual=residual, dt_s=dt_s, excess=excess):
                cov = covariance(dt_s, excess, *np.exp(logs))
                return 0.5 * np.sum(residual * np.linalg.solve(cov, residual)) + 1.5 * np.linalg.slogdet(cov)[1]

            found = align_fit._estimate_noise(residual, dt_s, excess, least_rate)
            assert found[0] >= 1e-12 and found[1] >= least_rate
            bounds = [(np.log(1e-12), 0.0), (np.log(least_rate), 0.0)]
            starts = np.log([[max(pose, 1e-12), max(rate, least_rate)], [1e-5, 1e-5]])
            truth = min(
                (minimize(cost, start, method="Nelder-Mead", bounds=bounds) for start in starts), key=lambda r: r.fun
            )
            assert cost(np.log(found)) <= truth.fun + 1e-3


def test_tail_of_the_chi_squared_distribution(subtests):
    for dof in range(1, 13):
        with subtests.test(dof=dof):
            for chi2 in (0.0, 1e-3, 0.5, 3.0, 20.0, 300.0):
                assert chi2_tail(chi2, dof) == pytest.approx(chdtrc(dof, chi2), rel=1e-12)
