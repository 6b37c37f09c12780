"""A slice of study_helicopter: the page's limits, where the linear filter ends, and what a wrong model costs."""

import numpy as np
import pytest

from inertial.helicopter import LinearRangeWarning
from studies import helicopter as study

FLIGHTS = 6
# Of the RMS of six flights of 20 s, whose errors last a second or so.
SAMPLING = 1.1
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


@LINEAR_PLANT
def test_a_wrong_model_costs_accuracy():
    right, wrong = (np.median(study.wrong_model_errors(error, 3)) for error in (0.0, 0.3))
    assert wrong > 2 * right


def test_every_eigenvalue_is_reproduced():
    misses = study.eigenvalue_misses()
    assert len(misses) == 7
    assert max(misses.values()) < 1
