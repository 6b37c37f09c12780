"""A slice of study_helicopter: the page's limits, where the linear filter ends, and what a wrong model costs."""

import numpy as np
import pytest

from inertial.helicopter import LinearRangeWarning
from inertial.rotation import (
    dcm_nb_from_euler,
    down_from_quaternion,
    down_from_roll_pitch,
    quaternion_from_dcm,
    roll_pitch_from_down,
)
from studies import helicopter as study

FLIGHTS = 6
SAMPLING = 1.1  # of the RMS of six flights of 20 s, whose errors last a second or so
STEP = 1e-4  # rad
LINEAR_PLANT = pytest.mark.filterwarnings("ignore::inertial.helicopter.LinearRangeWarning")


@LINEAR_PLANT
def test_the_filter_is_within_its_limit_and_says_so():
    flights = [study.flight(seed=seed) for seed in range(FLIGHTS)]
    filtered = [study.errors_deg(run, run.filtered[:, :2]) for run in flights]
    raw = [study.errors_deg(run, run.measured[:, :2]) for run in flights]
    expected = study.expected_deg(study.filter_of(study.r50_hover()))
    assert (expected < study.FILTERED_LIMIT_DEG).all()
    assert study.rms(filtered) < min(study.FILTERED_LIMIT_DEG, SAMPLING * study.rms(expected))
    assert study.rms(raw) == pytest.approx(study.RAW_DEG, rel=SAMPLING - 1)


def test_at_thirty_degrees_the_models_filter_is_worse_than_the_sensor_and_the_gyros_is_not():
    with pytest.warns(LinearRangeWarning):
        run = study.flight(nonlinear=True)
    raw, model, gyros = (study.errors_deg(run, roll_pitch)[1] for roll_pitch in (
        run.measured[:, :2], run.filtered[:, :2], study.gyro_filter(run)))
    assert model > 3 * raw
    assert gyros < 0.1 * raw


def test_near_hover_the_models_filter_is_good_on_nonlinear_kinematics_too():
    run = study.flight(0.1 * study.COMMAND, nonlinear=True)
    assert study.errors_deg(run, run.filtered[:, :2]).max() < 0.2 * study.RAW_DEG


def test_a_measurement_without_noise_is_taken_and_a_certain_attitude_kept():
    """R to zero and P to zero: the limits of the gain in chapter 3 of the Vietnamese paper."""
    measured_b, down_n = down_from_roll_pitch(0.2 + STEP, -0.1), np.array([0.0, 0.0, 1.0])
    before = quaternion_from_dcm(dcm_nb_from_euler(0.2, -0.1, 1.0))
    for attitude_variance, variance, roll in ((1.0, 1e-8, 0.2 + STEP), (1e-20, 1.0, 0.2)):
        q = before.copy()
        study.kernels.mekf_vector_update(q, np.zeros(3), attitude_variance * np.eye(6), measured_b, down_n,
                                         variance * np.eye(3), np.inf)
        assert roll_pitch_from_down(down_from_quaternion(q)) == pytest.approx((roll, -0.1), abs=STEP**2)


@LINEAR_PLANT
def test_a_wrong_model_costs_accuracy():
    right, wrong = (np.median(study.wrong_model_errors(error, 3)) for error in (0.0, 0.3))
    assert wrong > 2 * right


def test_every_eigenvalue_is_reproduced():
    misses = study.eigenvalue_misses()
    assert len(misses) == 7
    assert max(misses.values()) < 1
