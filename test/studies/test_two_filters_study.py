"""A slice of study_two_filters: the page's limits on a few runs."""

import numpy as np
import pytest

from studies import two_filters as study

RUNS = 3
# Of 3 runs: the mean NEES of 18 degrees of freedom, 3 sigma, were its errors of one run all alike.
ANEES_LOW, ANEES_HIGH = 6 / 3, 6 * 2.1
OVERCONFIDENT = 2.0  # times the ANEES of the other axes
HONEST = (0.1, 4.0)  # NEES for each state of one flight whose errors last a minute
BIAS_LEFT = 1e-3  # of what is left: the simulation's steps


@pytest.mark.parametrize("rate", study.RATES)
def test_closed_forms(rate):
    assert study.closed_form_error(rate, 0.1) < study.CLOSED_FORM_LIMIT


@pytest.mark.parametrize("heading", [True, False])
def test_the_attitude_filter_is_consistent(heading):
    assert ANEES_LOW < study.mekf_runs(RUNS, heading, duration=20.0).anees() < ANEES_HIGH


def test_the_papers_gain_is_stable_up_to_its_limit():
    assert study.spectral_radius(0.999 * study.STEADY_GAIN_LIMIT) < 1 < study.spectral_radius(
        1.001 * study.STEADY_GAIN_LIMIT)
    assert study.riccati_radius(1.5) < 1


def test_a_bias_leaves_what_the_closed_form_says():
    r, u = study.bias_left(0.1, 1.0, duration=20.0)
    np.testing.assert_allclose([r, u], [0.1, np.sqrt(2) * 0.1], rtol=BIAS_LEFT)


def test_a_slow_error_of_the_fixes_is_in_the_covariance():
    recording, _ = study.flight(0, 120.0)
    aids = study.receive(recording, study.Receiver(5.0, 0.2, 0.8), np.random.default_rng(1))
    params = study.sensor_params(fix_slow_share=0.8, fix_slow_time=study.SLOW_TIME)
    *_, nees = study.errors_and_nees(recording, study.navigate(recording, aids, params, 20))
    *_, white = study.errors_and_nees(recording, study.navigate(recording, aids, study.sensor_params(), 20))
    assert HONEST[0] < nees < HONEST[1] < white
