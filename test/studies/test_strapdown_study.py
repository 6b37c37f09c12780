"""A slice of study_strapdown: its exact motions, and the page's limits on shorter runs."""

import numpy as np
import pytest

from studies import strapdown as study

DIFFERENCE = 1e-3  # s, step of central differences
RATE_DIFFERENCE = 1e-8  # rad/s, of central differences
ACCELERATION_DIFFERENCE = 1e-8  # m/s^2
SHORT = 60.0  # s


def test_the_exact_motion_is_consistent():
    motion, t = study.vibrating(study.MANOEUVRE), np.linspace(1.0, 300.0, 40)
    before, after = motion.state(t - 1e-5), motion.state(t + 1e-5)
    _, acceleration_n = motion._velocity_n(t)
    slope = (after.velocity_n - before.velocity_n) / 2e-5
    np.testing.assert_allclose(acceleration_n, slope, atol=1e-4)  # the vibration's third derivative


def test_the_means_are_the_integrals_of_the_motion():
    motion = study.MANOEUVRE
    fine_gyro_b, fine_accel_b = motion.samples(0.1, 1e-3)
    gyro_b, accel_b = motion.samples(0.1, 0.01)
    np.testing.assert_allclose(fine_gyro_b.reshape(10, 10, 3).mean(axis=1), gyro_b, atol=RATE_DIFFERENCE)
    np.testing.assert_allclose(fine_accel_b.reshape(10, 10, 3).mean(axis=1), accel_b, atol=ACCELERATION_DIFFERENCE)


@pytest.mark.parametrize("scheme", study.CONING_LIMITS)
def test_coning_and_sculling_are_within_the_limits(scheme):
    assert study.coning_drift(scheme, 20.0, duration=2.0) < study.CONING_LIMITS[scheme]
    assert study.coning_order(scheme) == pytest.approx(study.ORDERS[scheme], abs=study.ORDER_TOLERANCE)
    assert study.sculling(scheme)[0] < study.SCULLING_LIMITS[scheme]


def test_a_manoeuvre_is_followed():
    error = study.largest_error(*study.navigate(study.MANOEUVRE, SHORT, "2", 0.005))
    assert error < study.MANOEUVRE_LIMIT


def test_vibration_is_followed_by_the_default_and_not_by_two_samples():
    default, two = (study.largest_error(*study.navigate(study.vibrating(study.MANOEUVRE), SHORT, scheme, 0.0025))
                    for scheme in ("2+previous", "2"))
    assert default < study.VIBRATION_LIMIT
    assert two > 5 * default


def test_no_latitude_is_special():
    assert study.pole_error(duration=SHORT) < study.MANOEUVRE_LIMIT


def test_point_samples_are_told_from_means():
    assert study.semantics_error("point", "point", 20.0) < 0.01 * study.semantics_error("point", "mean", 20.0)
