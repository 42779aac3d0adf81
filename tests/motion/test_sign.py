"""A gyroscope of the wrong sign is told from the right one by the way between frames."""

import numpy as np

from colmap_inertial.motion.sign import compare_signs


def turns(seed, count=20, size_rad=0.05):
    return size_rad * np.random.default_rng(seed).standard_normal((count, 3))


def seen(inertial, seed, noise_rad=0.004):
    rng = np.random.default_rng([seed, 1])
    return inertial + noise_rad * rng.standard_normal(inertial.shape), np.full(len(inertial), noise_rad)


def test_the_sign_is_told_also_among_pairs_that_were_measured_wrongly(subtests):
    for seed in range(5):
        with subtests.test(seed=seed):
            inertial = turns(seed)
            visual, sigma_rad = seen(inertial, seed)
            visual[::4] = turns(seed + 50)[::4]
            assert compare_signs(visual, inertial, sigma_rad).right is True
            wrong = compare_signs(visual, -inertial, sigma_rad)
            assert wrong.right is False and wrong.reason.code == "sign-wrong"


def test_still_unknown_and_unrelated_turns_tell_nothing():
    still = turns(3, size_rad=0.001)
    visual, sigma_rad = seen(still, 3)
    assert compare_signs(visual, still, sigma_rad).right is None
    none = np.zeros((0, 3))
    assert compare_signs(none, none, np.zeros(0)).right is None
    for seed in range(20):
        assert compare_signs(turns(seed), turns(seed + 100), np.full(20, 0.004)).right is None


def test_pixels_that_turn_back_a_little_around_an_object_refuse_no_gyroscope():
    # a camera that circles an object: translation moves its pixels against the turn, by a bit more
    inertial = turns(7)
    visual, sigma_rad = seen(-0.3 * inertial, 7, 0.002)
    assert compare_signs(visual, inertial, sigma_rad).right is not False
