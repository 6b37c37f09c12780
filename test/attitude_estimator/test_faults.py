"""Bad input: the output stays finite, heals within ten seconds, and every fault is counted once."""

import math
from dataclasses import asdict
from functools import cache

import numpy as np
import pytest

from attitude_estimator import _kernels as kernels
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.simulator import simulate

HEALED_DEG = 0.5  # from the run without the fault, 10 s after its end
HEAL_TIME = 10.0  # s
STEP_DEG = 0.3  # what a step of the altimeter may move the tilt
STEP_SIGMAS = 1.0  # the same in hard motion; a step of 1 m passes for noise at first
DRIFT_DEG = 0.5  # what its drift may
GLITCH_DEG = 0.5  # what one bridged sample in a manoeuvre may move the tilt at most
RATE = 100
FAULT_AT = 20.0  # s, in flight
GLITCHES = ("quad", "turn", "hover")  # faults of one sample now and then heal in any motion
LASTING = ("hover", "straight")  # in a violent one, seconds without a sensor cost more than 10 s heal


@cache
def _recording(scenario):
    return simulate(scenario, duration=45.0, imu_rate=RATE, altimeter_rate=20.0, seed=11)


@cache
def _clean(scenario):
    estimator = AttitudeEstimator()
    estimates, _ = estimator.run(_recording(scenario).imu, _recording(scenario).altitude)
    assert not any(asdict(estimator.faults).values())
    return estimates


def _copy(imu):
    return ImuSeries(imu.stamp_ns.copy(), imu.gyro_b.copy(), imu.accel_b.copy())


def _angle_deg(down_b, other_b):
    cross = np.linalg.norm(np.cross(down_b, other_b), axis=-1)
    return np.degrees(np.arctan2(cross, np.sum(down_b * other_b, axis=-1)))


def _span(seconds, start=FAULT_AT):
    return slice(int(start * RATE), int((start + seconds) * RATE))


def _run(scenario, change, params=None):
    """Run with the samples that ``change(imu)`` spoils; return estimator, estimates, tilt from clean."""
    imu = _copy(_recording(scenario).imu)
    change(imu)
    estimator = AttitudeEstimator(params)
    estimates, _ = estimator.run(imu, _recording(scenario).altitude)
    assert np.all(np.isfinite(estimates.rows))
    clean = _clean(scenario)
    at = np.searchsorted(clean.stamp_ns, estimates.stamp_ns)
    return estimator, estimates, _angle_deg(estimates.down_b, clean.down_b[at])


def _healed(estimates, apart_deg, end, start_ns):
    late = estimates.stamp_ns >= start_ns + round((end + HEAL_TIME) * 1e9)
    return estimates.valid[late].all() and apart_deg[late].max() < HEALED_DEG


def _check(scenario, change, end, params=None, **counts):
    """Run, and check that it heals and that exactly these faults were counted."""
    estimator, estimates, apart_deg = _run(scenario, change, params)
    assert {name: n for name, n in asdict(estimator.faults).items() if n} == counts
    assert _healed(estimates, apart_deg, end, _recording(scenario).imu.stamp_ns[0])
    return estimates, apart_deg


# --- rows 1 to 7: values ----------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", GLITCHES)
def test_a_clean_run_counts_nothing(scenario):
    assert np.all(np.isfinite(_clean(scenario).rows))


@pytest.mark.parametrize("scenario", GLITCHES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_row_1_one_gyro_sample_that_is_not_finite_is_bridged(scenario, bad):
    def change(imu):
        imu.gyro_b[int(FAULT_AT * RATE), 1] = bad

    estimates, apart_deg = _check(scenario, change, FAULT_AT, gyro_not_finite=1)
    assert len(estimates) == len(_recording(scenario).imu)
    assert apart_deg.max() < GLITCH_DEG


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_1_every_tenth_gyro_sample_that_is_not_finite_is_bridged(scenario):
    def change(imu):
        imu.gyro_b[_span(5.0)][::10] = math.nan

    _check(scenario, change, FAULT_AT + 5.0, gyro_not_finite=50)


@pytest.mark.parametrize("scenario", LASTING)
def test_row_1_a_good_rate_is_held_for_50_ms_and_then_nothing_is_published(scenario):
    def change(imu):
        imu.gyro_b[_span(0.2)] = math.nan

    estimates, _ = _check(scenario, change, FAULT_AT + 0.2, gyro_not_finite=20)
    assert len(estimates) == len(_recording(scenario).imu) - 15


@pytest.mark.parametrize("scenario", LASTING)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_row_2_without_a_finite_force_the_attitude_goes_on_by_the_gyro(scenario, bad):
    def change(imu):
        imu.accel_b[_span(2.0), 2] = bad

    estimates, _ = _check(scenario, change, FAULT_AT + 2.0, accel_not_finite=200)
    assert len(estimates) == len(_recording(scenario).imu)
    during = int((FAULT_AT + 1.9) * RATE)
    assert estimates.vd_variance[during] > 2.0 * _clean(scenario).vd_variance[during]


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_3_values_beyond_the_sensors_range_are_refused(scenario):
    def change(imu):
        imu.gyro_b[_span(1.0)][::20, 0] = 40.0
        imu.accel_b[_span(1.0)][5::20, 0] = -200.0

    params = AttitudeParams(gyro_range=34.9, accel_range=156.9)
    _, apart_deg = _check(scenario, change, FAULT_AT + 1.0, params,
                          gyro_out_of_range=5, accel_out_of_range=5)
    assert apart_deg.max() < GLITCH_DEG


@pytest.mark.parametrize("scenario", [*LASTING, "turn"])
def test_row_4_a_force_of_zero_is_free_fall_not_gravity(scenario):
    def change(imu):
        imu.accel_b[_span(3.0)] = 0.0

    estimator, estimates, apart_deg = _run(scenario, change)
    assert _healed(estimates, apart_deg, FAULT_AT + 3.0, _recording(scenario).imu.stamp_ns[0])
    assert not estimator.free_fall


@pytest.mark.parametrize("share", [0.0, 0.001])
def test_row_4_free_fall_and_zeros_are_told(share):
    estimator = AttitudeEstimator()
    imu = _recording("quad").imu
    for k in range(1000):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k] * (1.0 if k < 600 else share))
    assert estimator.free_fall or estimator.faults.accel_zero == 400


@pytest.mark.parametrize("force", [0.0, 0.02])
def test_row_5_without_gravity_at_the_start_there_is_no_attitude_and_it_says_why(force):
    rng = np.random.default_rng(1)
    estimator = AttitudeEstimator()
    for k in range(1000):
        estimator.add_imu(1 + k * 10_000_000, 1e-3 * rng.standard_normal(3), force * rng.standard_normal(3))
        assert not estimator.estimate.valid
        assert np.all(np.isfinite(estimator.estimate.rows))
    assert "force" in estimator.waiting_for


def test_row_5_gravity_that_comes_later_ends_the_waiting():
    estimator = AttitudeEstimator()
    for k in range(2000):
        force = np.array([0.0, 0.0, -9.8]) * (k >= 500)
        estimator.add_imu(1 + k * 10_000_000, np.zeros(3) + 1e-6 * k, force)
    assert estimator.estimate.valid
    assert _angle_deg(estimator.estimate.down_b, np.array([0.0, 0.0, 1.0])) < HEALED_DEG


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_6_clipped_samples_count_and_widen_the_covariance(scenario):
    limit = 10.0

    def at_the_limit(imu):
        imu.gyro_b[_span(0.5), 0] = limit

    def below_it(imu):
        imu.gyro_b[_span(0.5), 0] = 0.99 * limit

    params = AttitudeParams(gyro_range=limit)
    clipped, flagged, _ = _run(scenario, at_the_limit, params)
    _, trusted, _ = _run(scenario, below_it, params)
    assert clipped.faults.clipped == 50
    after = int((FAULT_AT + 0.5) * RATE)
    wide, narrow = (np.trace(e.tilt_covariance_n[after]) for e in (flagged, trusted))
    assert wide > 2.0 * narrow


@pytest.mark.parametrize("scenario", LASTING)
def test_row_7_a_stuck_sensor_is_counted_after_a_second_and_widens_the_covariance(scenario):
    def change(imu):
        span = _span(1.5)
        imu.gyro_b[span], imu.accel_b[span] = imu.gyro_b[span][0], imu.accel_b[span][0]

    estimator, estimates, apart_deg = _run(scenario, change)
    assert estimator.faults.stuck == pytest.approx(0.5 * RATE, abs=2)
    assert _healed(estimates, apart_deg, FAULT_AT + 1.5, _recording(scenario).imu.stamp_ns[0])
    before, after = (np.trace(estimates.tilt_covariance_n[int((FAULT_AT + t) * RATE)]) for t in (0.9, 1.4))
    assert after > 1.5 * before


# --- rows 9 to 13: stamps ---------------------------------------------------------------------------


def _without(imu, span):
    kept = np.ones(len(imu), dtype=bool)
    kept[span] = False
    return ImuSeries(imu.stamp_ns[kept], imu.gyro_b[kept], imu.accel_b[kept])


def _run_without(scenario, span):
    """Run with a gap in the IMU; return as ``_run``."""
    recording = _recording(scenario)
    imu = _without(recording.imu, span)
    altitude = recording.altitude
    arrival = np.searchsorted(imu.stamp_ns, altitude.stamp_ns, side="right")
    estimator = AttitudeEstimator()
    estimates, _ = estimator.run(imu, AltitudeSeries(altitude.stamp_ns, altitude.altitude, arrival))
    assert np.all(np.isfinite(estimates.rows))
    clean = _clean(scenario)
    at = np.searchsorted(clean.stamp_ns, estimates.stamp_ns)
    return estimator, estimates, _angle_deg(estimates.down_b, clean.down_b[at])


@pytest.mark.parametrize("scenario", LASTING)
@pytest.mark.parametrize("gap", [0.1, 0.5, 0.9])
def test_row_12_a_gap_up_to_the_limit_is_bridged_with_a_larger_covariance(scenario, gap):
    span = _span(gap)
    estimator, estimates, apart_deg = _run_without(scenario, span)
    assert not any(asdict(estimator.faults).values())
    assert _healed(estimates, apart_deg, FAULT_AT + gap, _recording(scenario).imu.stamp_ns[0])
    assert estimates.valid[span.start]
    bridged = np.trace(estimates.tilt_covariance_n[span.start])
    assert bridged > np.trace(_clean(scenario).tilt_covariance_n[span.stop])
    assert np.radians(apart_deg[span.start]) < 5.0 * math.sqrt(bridged)


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_13_after_a_longer_gap_it_starts_anew_and_keeps_the_biases(scenario):
    span = _span(2.0)
    estimator, estimates, _ = _run_without(scenario, span)
    assert estimator.faults.restarted == 1
    assert estimates.valid[span.start - 1] and not estimates.valid[span.start]
    np.testing.assert_array_equal(estimates.gyro_bias_b[span.start], estimates.gyro_bias_b[span.start - 1])


def test_row_13_after_a_long_gap_at_rest_it_heals():
    recording = simulate("hover", duration=45.0, rest=45.0, imu_rate=RATE, seed=2)
    clean, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
    estimator = AttitudeEstimator()
    estimates, _ = estimator.run(_without(recording.imu, _span(3.0)))
    apart_deg = _angle_deg(estimates.down_b[-1], clean.down_b[-1])
    assert estimator.faults.restarted == 1
    assert estimates.valid[-1] and apart_deg < HEALED_DEG


# --- rows 18 to 23: altitude ------------------------------------------------------------------------


def _run_altitude(scenario, change):
    """Run with the altitudes that ``change(stamp since start, altitude, arrival)`` returns."""
    recording = _recording(scenario)
    altitude = recording.altitude
    t = (altitude.stamp_ns - recording.imu.stamp_ns[0]) * 1e-9
    kept, values = change(t, altitude.altitude.copy())
    estimator = AttitudeEstimator()
    estimates, _ = estimator.run(
        recording.imu, AltitudeSeries(altitude.stamp_ns[kept], values[kept], altitude.arrival[kept]))
    assert np.all(np.isfinite(estimates.rows))
    return estimator, estimates, _angle_deg(estimates.down_b, _clean(scenario).down_b)


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_18_without_altitude_it_runs_on_the_imu_with_a_larger_covariance(scenario):
    estimates, _ = AttitudeEstimator().run(_recording(scenario).imu)
    assert np.all(np.isfinite(estimates.rows))
    late = slice(20 * RATE, None)
    alone, aided = (np.trace(e.tilt_covariance_n[late], axis1=1, axis2=2).mean()
                    for e in (estimates, _clean(scenario)))
    assert alone > aided
    assert estimates.altitude_variance[-1] > 5.0**2


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_19_an_altitude_that_returns_re_enters_without_a_step_in_attitude(scenario):
    start, stop = FAULT_AT, FAULT_AT + 8.0
    estimator, estimates, apart_deg = _run_altitude(
        scenario, lambda t, z: ((t < start) | (t > stop), z))
    assert not any(asdict(estimator.faults).values())
    assert _healed(estimates, apart_deg, stop, _recording(scenario).imu.stamp_ns[0])
    at = int(stop * RATE)
    own = _angle_deg(estimates.down_b[at + 1:at + 10], estimates.down_b[at:at + 9])
    clean = _clean(scenario).down_b
    assert np.all(own - _angle_deg(clean[at + 1:at + 10], clean[at:at + 9]) < STEP_DEG)
    assert estimates.altitude_variance[at - 10] > 2.0 * _clean(scenario).altitude_variance[at - 10]


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_20_altitudes_that_are_not_finite_are_refused(scenario):
    def change(t, z):
        z[(t > FAULT_AT) & (t <= FAULT_AT + 1.0)] = np.resize([math.nan, math.inf, -math.inf], 20)
        return np.ones(len(t), dtype=bool), z

    estimator, estimates, apart_deg = _run_altitude(scenario, change)
    assert {k: n for k, n in asdict(estimator.faults).items() if n} == {"altitude_not_finite": 20}
    assert _healed(estimates, apart_deg, FAULT_AT + 1.0, _recording(scenario).imu.stamp_ns[0])


@pytest.mark.parametrize(("scenario", "step"), [
    ("hover", 1.0), ("turn", 1.0), ("turn", 5.0), ("hover", 5.0), ("turn", -8.0)])
def test_row_21_a_step_in_altitude_moves_the_reference_not_the_attitude(scenario, step):
    _, estimates, apart_deg = _run_altitude(
        scenario, lambda t, z: (np.ones(len(t), dtype=bool), z + step * (t > FAULT_AT)))
    assert apart_deg.max() < STEP_DEG
    late = slice(int((FAULT_AT + HEAL_TIME) * RATE), None)
    moved = (estimates.altitude - _clean(scenario).altitude)[late]
    assert np.mean(moved) == pytest.approx(step, abs=0.2 * abs(step) + 0.1)


def _step_told(step):
    """Run "quad" with a step in altitude whose instant, not whose size, the filter is told; return tilt from clean."""
    imu, altitude = _recording("quad").imu, _recording("quad").altitude
    after = altitude.stamp_ns - imu.stamp_ns[0] > FAULT_AT * 1e9
    at = altitude.arrival[after][0]
    estimator = AttitudeEstimator()
    estimator.run(ImuSeries(imu.stamp_ns[:at], imu.gyro_b[:at], imu.accel_b[:at]),
                  AltitudeSeries(altitude.stamp_ns[~after], altitude.altitude[~after], altitude.arrival[~after]))
    estimator._memory[kernels.P + (kernels.N + 1) * kernels.ALT] += 1e4
    estimates, _ = estimator.run(
        ImuSeries(imu.stamp_ns[at:], imu.gyro_b[at:], imu.accel_b[at:]),
        AltitudeSeries(altitude.stamp_ns[after], altitude.altitude[after] + step, altitude.arrival[after] - at))
    return _angle_deg(estimates.down_b, _clean("quad").down_b[at:])


# In hard motion an altitude tells much, and a step of unknown size parts those before it from those after it.
@pytest.mark.parametrize(("step", "of_told"), [(1.0, 2.5), (5.0, 1.1), (-8.0, 1.1)])
def test_row_21_in_hard_motion_a_step_costs_little_more_than_not_knowing_its_size_must(step, of_told):
    _, estimates, apart_deg = _run_altitude(
        "quad", lambda t, z: (np.ones(len(t), dtype=bool), z + step * (t > FAULT_AT)))
    assert apart_deg.max() < of_told * _step_told(step).max()
    valid = estimates.valid
    sigma_deg = np.degrees(np.sqrt(np.trace(estimates.tilt_covariance_n[valid], axis1=1, axis2=2)))
    assert np.max(apart_deg[valid] / sigma_deg) < STEP_SIGMAS


@pytest.mark.parametrize("scenario", GLITCHES)
def test_row_22_an_altitude_that_drifts_does_not_tilt(scenario):
    drift = 0.05  # m/s: a passing front is a tenth of it
    _, _, apart_deg = _run_altitude(scenario, lambda t, z: (np.ones(len(t), dtype=bool), z + drift * t))
    assert apart_deg.max() < DRIFT_DEG
