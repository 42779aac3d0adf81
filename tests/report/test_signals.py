"""Spectra of the report."""

import numpy as np
import pytest

from colmap_inertial.report import signals


def test_the_spectrum_of_white_noise_is_its_density_up_to_half_the_rate():
    t_s = np.arange(0.0, 60.0, 0.005)
    noise = 0.1 * np.random.default_rng(4).standard_normal((len(t_s), 3))
    found = signals._estimate_spectrum(t_s, noise)
    hz, density = (np.asarray(found[name], dtype=float) for name in ("hz", "density"))
    # of a vector: of three axes, one-sided
    expected = 0.1 * np.sqrt(3 * 2 * 0.005)
    # 120 bins from the lowest frequency, of parts of 8 s, to half the rate
    assert np.log(hz[-2] / hz[-22]) == pytest.approx(20 * np.log(100 * 8) / 120, rel=0.02)
    np.testing.assert_allclose(density[hz > 10], expected, rtol=0.15)
    assert np.mean(density[hz > 10]) == pytest.approx(expected, rel=0.02)
