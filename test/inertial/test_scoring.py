"""Scores of attitudes with known errors."""

import numpy as np
import pytest

from inertial import rotation
from inertial.recording import AttitudeSeries
from inertial.scoring import interpolate_down, score_attitude, tilt_error_n

ROUNDING_DEG = 1e-9  # an injected error is found again to rounding
STEP_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000
SETTLED = 1500  # of 2000 samples at 100 Hz, after the first 5 s


def _truth(count=2000):
    k = np.arange(count)
    q = rotation.quaternion_from_dcm(rotation.dcm_nb_from_euler(
        1.2 * np.sin(0.002 * k), 0.6 * np.sin(0.003 * k), 0.004 * k))
    return AttitudeSeries(START_NS + STEP_NS * k, q)


def _tilted(truth, north, east, down=0.0):
    """Attitudes wrong by a small rotation about their own navigation axes."""
    count = len(truth)
    vector = np.stack(np.broadcast_arrays(north, east, down, np.zeros(count))[:3], axis=-1)
    return rotation.quaternion_multiply(rotation.quaternion_exp(vector), truth.q_nb_wxyz)


def _isotropic(count, tilt_std):
    return np.tile(np.eye(2) * tilt_std ** 2 / 2, (count, 1, 1))


def _score(truth, q, tilt_std=0.01, valid=None, **kwargs):
    valid = np.ones(len(truth), dtype=bool) if valid is None else valid
    return score_attitude(truth.stamp_ns, q, _isotropic(len(truth), tilt_std), valid,
                          kwargs.pop("against", truth), **kwargs)


def test_perfect_attitude_scores_zero():
    truth = _truth()
    score = _score(truth, truth.q_nb_wxyz, tilt_std=0.02)
    assert score.tilt_rms_deg == pytest.approx(0.0, abs=ROUNDING_DEG)
    assert score.roll_rms_deg == pytest.approx(0.0, abs=ROUNDING_DEG)
    assert score.pitch_rms_deg == pytest.approx(0.0, abs=ROUNDING_DEG)
    assert score.coverage_3sigma == 1.0
    assert score.samples == SETTLED
    assert score.skipped_s == 0.0
    assert score.predicted_tilt_deg == pytest.approx(np.degrees(0.02))
    assert score.median_sigma_deg == pytest.approx(np.degrees(0.02))


def test_heading_does_not_count():
    truth = _truth()
    score = _score(truth, _tilted(truth, 0.0, 0.0, down=2.0))
    assert score.tilt_rms_deg == pytest.approx(0.0, abs=ROUNDING_DEG)


def test_constant_tilt_error_is_found_exactly():
    truth = _truth()
    score = _score(truth, _tilted(truth, np.radians(3.0), np.radians(-4.0)))
    assert score.tilt_rms_deg == pytest.approx(5.0, abs=ROUNDING_DEG)


def test_roll_and_pitch_errors_are_separate_and_wrapped():
    count = 600
    stamp_ns = START_NS + STEP_NS * np.arange(count)
    truth_q, estimate_q = (
        np.tile(rotation.quaternion_from_dcm(rotation.dcm_nb_from_euler(roll, pitch, 0.0)),
                (count, 1)) for roll, pitch in [(np.radians(179), 0.1), (np.radians(-179), 0.0)])
    score = _score(AttitudeSeries(stamp_ns, truth_q), estimate_q)
    assert score.roll_rms_deg == pytest.approx(2.0, abs=ROUNDING_DEG)
    assert score.pitch_rms_deg == pytest.approx(np.degrees(0.1), abs=ROUNDING_DEG)


def test_error_vector_is_the_rotation_put_in_and_holds_at_large_angles():
    truth = _truth(50)
    q = _tilted(truth, 1.5, -2.0)
    error = tilt_error_n(q, rotation.down_from_quaternion(truth.q_nb_wxyz))
    assert error == pytest.approx(np.tile([1.5, -2.0], (50, 1)), abs=1e-12)


def test_nees_uses_the_axes_of_the_covariance():
    truth = _truth()
    covariance = np.tile(np.diag([0.01 ** 2, 0.04 ** 2]), (len(truth), 1, 1))
    score = score_attitude(truth.stamp_ns, _tilted(truth, 0.02, 0.04), covariance,
                           np.ones(len(truth), dtype=bool), truth)
    assert score.nees == pytest.approx(2.0 ** 2 + 1.0 ** 2)


def test_errors_drawn_from_the_covariance_give_nees_two_and_the_rayleigh_coverage():
    truth, std = _truth(20_500), 0.01
    rng = np.random.default_rng(3)
    north, east = std * rng.standard_normal((2, len(truth)))
    score = _score(truth, _tilted(truth, north, east), tilt_std=std * np.sqrt(2))
    four_sigma = 4 * 2 / np.sqrt(20_000)
    assert score.nees == pytest.approx(2.0, abs=four_sigma)
    assert score.coverage_3sigma == pytest.approx(1 - np.exp(-9), abs=4e-4)
    assert score.tilt_rms_deg == pytest.approx(score.predicted_tilt_deg, rel=0.03)


def test_stamps_without_attitude_are_not_covered_and_do_not_count_in_rms():
    truth = _truth()
    valid = np.arange(len(truth)) >= 800
    wrong = np.where(valid, 0.001, 1.0)
    score = _score(truth, _tilted(truth, wrong, 0.0), valid=valid)
    assert score.tilt_rms_deg == pytest.approx(np.degrees(0.001), abs=ROUNDING_DEG)
    assert score.samples == 1200
    assert score.coverage_3sigma == pytest.approx(1200 / SETTLED)
    assert score.skipped_s == pytest.approx(2.99)  # the 299 intervals from 5 s to the first attitude


def test_never_an_attitude_is_no_coverage_at_all():
    truth = _truth()
    score = _score(truth, truth.q_nb_wxyz, valid=np.zeros(len(truth), dtype=bool))
    assert score.coverage_3sigma == 0.0
    assert score.samples == 0
    assert np.isnan(score.tilt_rms_deg)
    assert score.skipped_s == pytest.approx(14.99)


def test_estimator_without_covariance_is_scored_for_its_errors_alone():
    truth = _truth()
    score = score_attitude(truth.stamp_ns, _tilted(truth, 0.01, 0.0), None,
                           np.ones(len(truth), dtype=bool), truth)
    assert score.tilt_rms_deg == pytest.approx(np.degrees(0.01), abs=ROUNDING_DEG)
    assert np.isnan(score.coverage_3sigma) and np.isnan(score.nees)


@pytest.mark.parametrize("lost, used", [(11, SETTLED), (12, SETTLED - 12)])
def test_truth_gap_above_120_ms_is_left_out(lost, used):
    truth = _truth()
    kept = np.ones(len(truth), dtype=bool)
    kept[1000:1000 + lost] = False
    against = AttitudeSeries(truth.stamp_ns[kept], truth.q_nb_wxyz[kept])
    score = _score(truth, truth.q_nb_wxyz, against=against)
    assert score.samples == used
    assert score.skipped_s == pytest.approx((SETTLED - used) * 0.01)


def test_slow_truth_may_have_gaps_of_three_of_its_steps():
    truth = _truth()
    sparse = np.arange(0, len(truth), 10)
    for lost, used in [(2, 1491), (3, 1491 - 39)]:
        kept = np.delete(sparse, np.arange(100, 100 + lost))
        against = AttitudeSeries(truth.stamp_ns[kept], truth.q_nb_wxyz[kept])
        assert _score(truth, truth.q_nb_wxyz, against=against).samples == used


def test_truth_is_interpolated_between_its_stamps():
    truth = AttitudeSeries(START_NS + np.array([0, 100_000_000]), np.stack([
        rotation.quaternion_exp([0.0, 0.0, 0.0]), -rotation.quaternion_exp([0.2, 0.0, 0.0])]))
    stamp_ns = START_NS + np.array([-1, 0, 25_000_000, 100_000_000, 100_000_001])
    down_b, spanned = interpolate_down(truth, stamp_ns)
    assert spanned.tolist() == [False, True, True, True, False]
    roll, _ = rotation.roll_pitch_from_down(down_b[1:4])
    assert roll == pytest.approx([0.0, 0.05, 0.2], abs=1e-14)


def test_bad_input_is_refused_with_its_reason():
    truth = _truth()
    later = AttitudeSeries(truth.stamp_ns + 10 ** 12, truth.q_nb_wxyz)
    empty = AttitudeSeries(truth.stamp_ns[:0], truth.q_nb_wxyz[:0])
    for against, reason in [(later, "no truth for any"), (empty, "no truth"), (None, "no truth")]:
        with pytest.raises(ValueError, match=reason):
            _score(truth, truth.q_nb_wxyz, against=against)
    with pytest.raises(ValueError, match="lengths differ"):
        _score(truth, truth.q_nb_wxyz[:-1])
    with pytest.raises(ValueError, match="not positive definite"):
        _score(truth, truth.q_nb_wxyz, tilt_std=0.0)
    with pytest.raises(ValueError, match="stamp_ns decreases"):
        _score(AttitudeSeries(truth.stamp_ns[::-1], truth.q_nb_wxyz), truth.q_nb_wxyz)
    with pytest.raises(ValueError, match="no estimates"):
        _score(empty, empty.q_nb_wxyz, against=truth)
