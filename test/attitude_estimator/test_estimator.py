"""What a program may rely on: conventions, streaming, late and lost altitudes, time, parameters."""

import copy
import math
from functools import cache

import numpy as np
import pytest

from attitude_estimator.estimator import (
    ACTION_RESET,
    ACTION_SKIP,
    AttitudeEstimator,
    Estimates,
    TimeJumpError,
)
from attitude_estimator.params import AttitudeParams
from inertial.earth import EARTH_RATE, normal_gravity
from inertial.imu_errors import AltimeterErrors, ImuErrors
from inertial.recording import AltitudeSeries, ImuSeries
from inertial.rotation import (
    dcm_from_quaternion,
    down_from_quaternion,
    down_from_roll_pitch,
    quaternion_from_dcm,
    roll_pitch_from_down,
)
from inertial.simulator import simulate

LEVEL_DEG = 0.05  # standing still with perfect sensors: what 20 s of settling leave
SAME_ATTITUDE = 1e-9  # rad, between two ways to write one attitude
IN_ORDER = 1e-12  # relative, of a state reached by another way, or by kernels that sum in another order
GRAVITY = 9.80665
RATE = 100
STEP_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000

MODELS = pytest.mark.parametrize("model", ["dcm_row", "dcm_row5"])


def _stand(estimator, roll=0.0, pitch=0.0, seconds=20.0, rate_b=(0.0, 0.0, 0.0), start=0):
    """Feed perfect samples of a body that stands still; return the index after the last one."""
    accel_b = -GRAVITY * down_from_roll_pitch(roll, pitch)
    stop = start + int(seconds * RATE)
    for k in range(start, stop):
        estimator.add_imu(START_NS + k * STEP_NS, np.array(rate_b), accel_b)
        if k % 5 == 0:
            estimator.add_altitude(START_NS + k * STEP_NS, 12.0)
    return stop


@cache
def _recording(duration=20.0):
    return simulate("quad", duration=duration, imu_rate=RATE, altimeter_rate=20.0, seed=5)


def _angle(down_b, other_b):
    return np.arctan2(np.linalg.norm(np.cross(down_b, other_b), axis=-1), np.sum(down_b * other_b, axis=-1))


def _stream(estimator, imu, altitude):
    """Feed sample by sample as the node does; return the rows of all estimates."""
    rows, j = [], 0
    for k in range(len(imu)):
        while j < len(altitude) and altitude.arrival[j] <= k:
            estimator.add_altitude(int(altitude.stamp_ns[j]), float(altitude.altitude[j]))
            j += 1
        if estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k]):
            rows.append(estimator.estimate.rows)
    return np.array(rows)


# --- conventions ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("roll", "pitch"), [
    (0.0, 0.0), (0.0, 0.4), (0.0, -0.4), (0.5, 0.0), (-0.5, 0.0), (3.0, 0.2), (0.3, 1.5)])
def test_a_still_body_has_its_roll_and_pitch(roll, pitch):
    estimator = AttitudeEstimator()
    _stand(estimator, roll, pitch)
    estimate = estimator.estimate
    assert estimate.valid
    assert np.degrees(_angle(estimate.down_b, down_from_roll_pitch(roll, pitch))) < LEVEL_DEG


def test_nose_up_is_positive_pitch_and_right_wing_down_positive_roll():
    nose_up, right_down, angle = AttitudeEstimator(), AttitudeEstimator(), math.atan2(3.0, 9.3)
    for k in range(1000):  # the force of gravity's reaction is up: forward when the nose points up
        nose_up.add_imu(START_NS + k * STEP_NS, np.zeros(3), np.array([3.0, 0.0, -9.3]))
        right_down.add_imu(START_NS + k * STEP_NS, np.zeros(3), np.array([0.0, -3.0, -9.3]))
    assert roll_pitch_from_down(nose_up.estimate.down_b)[1] == pytest.approx(angle, abs=0.01)
    assert roll_pitch_from_down(right_down.estimate.down_b)[0] == pytest.approx(angle, abs=0.01)


def test_the_quaternion_is_a_rotation_whose_down_axis_is_the_estimate():
    estimates, _ = AttitudeEstimator().run(_recording().imu, _recording().altitude)
    q = estimates.q_nb_wxyz[estimates.valid]
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=SAME_ATTITUDE)
    np.testing.assert_allclose(down_from_quaternion(q), estimates.down_b[estimates.valid], atol=SAME_ATTITUDE)
    turned_back = quaternion_from_dcm(dcm_from_quaternion(q))
    np.testing.assert_allclose(np.abs(np.sum(turned_back * q, axis=1)), 1.0, atol=SAME_ATTITUDE)


def test_yaw_starts_to_the_east_integrates_the_gyro_and_leaves_roll_and_pitch():
    estimator = AttitudeEstimator()
    k = _stand(estimator, seconds=10.0)
    assert estimator.estimate.q_nb_wxyz == pytest.approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], abs=1e-3)
    before = estimator.estimate.yaw_variance
    _stand(estimator, seconds=1.0, rate_b=(0.0, 0.0, 1.0), start=k)
    dcm_nb = dcm_from_quaternion(estimator.estimate.q_nb_wxyz)
    heading = math.atan2(dcm_nb[1, 0], dcm_nb[0, 0])
    assert heading == pytest.approx(math.pi / 2 + 1.0, abs=0.01)
    assert np.degrees(_angle(estimator.estimate.down_b, [0.0, 0.0, 1.0])) < LEVEL_DEG
    assert estimator.estimate.yaw_variance > before


def test_vertical_velocity_is_positive_down_and_altitude_up():
    recording = simulate("vertical_plane", duration=60.0, imu_rate=RATE, profile="perfect")
    estimates, fresh = AttitudeEstimator().run(recording.imu, recording.altitude)
    late = slice(30 * RATE, None)
    error = estimates.vd - recording.velocity_n[fresh, 2]
    assert np.abs(recording.velocity_n[late, 2]).max() > 20.0
    assert np.sqrt(np.mean(error[late] ** 2)) < 1.0  # m/s
    assert np.abs(estimates.altitude + recording.position_n[fresh, 2])[late].max() < 1.0  # m


# --- streaming, chunks, copies ----------------------------------------------------------------------


@MODELS
def test_streaming_gives_the_numbers_of_the_recording(model):
    recording, params = _recording(), AttitudeParams(estimator=model)
    batch, fresh = AttitudeEstimator(params).run(recording.imu, recording.altitude)
    streamed = _stream(AttitudeEstimator(params), recording.imu, recording.altitude)
    assert fresh.all()
    np.testing.assert_allclose(streamed, batch.rows, rtol=IN_ORDER, atol=IN_ORDER)


@pytest.mark.parametrize("cut", [1, 777, 1234])
def test_a_recording_in_two_parts_gives_the_same(cut):
    imu, altitude = _recording().imu, _recording().altitude
    whole, _ = AttitudeEstimator().run(imu, altitude)
    first = altitude.arrival <= cut
    estimator = AttitudeEstimator()
    one, _ = estimator.run(ImuSeries(imu.stamp_ns[:cut], imu.gyro_b[:cut], imu.accel_b[:cut]),
                           AltitudeSeries(altitude.stamp_ns[first], altitude.altitude[first],
                                          altitude.arrival[first]))
    two, _ = estimator.run(ImuSeries(imu.stamp_ns[cut:], imu.gyro_b[cut:], imu.accel_b[cut:]),
                           AltitudeSeries(altitude.stamp_ns[~first], altitude.altitude[~first],
                                          altitude.arrival[~first] - cut))
    np.testing.assert_array_equal(whole.rows, np.concatenate([one.rows, two.rows]))


@MODELS
def test_after_a_recording_the_estimate_is_its_last_row(model):
    estimator = AttitudeEstimator(AttitudeParams(estimator=model))
    estimates, _ = estimator.run(_recording().imu, _recording().altitude)
    np.testing.assert_array_equal(estimator.estimate.rows, estimates.rows[-1])
    assert estimator.estimate.stamp_ns == estimates.stamp_ns[-1]


def test_a_copy_goes_on_like_the_original_and_alone():
    imu = _recording().imu
    original = AttitudeEstimator()
    original.run(imu, _recording().altitude)
    twin = copy.deepcopy(original)
    stamp_ns = int(imu.stamp_ns[-1]) + STEP_NS
    before = original.estimate.rows
    twin.add_imu(stamp_ns, imu.gyro_b[-1], imu.accel_b[-1])
    np.testing.assert_array_equal(original.estimate.rows, before)
    original.add_imu(stamp_ns, imu.gyro_b[-1], imu.accel_b[-1])
    np.testing.assert_array_equal(original.estimate.rows, twin.estimate.rows)


def test_an_estimate_is_a_copy_that_later_samples_leave_alone():
    estimator = AttitudeEstimator()
    k = _stand(estimator, seconds=5.0)
    kept = estimator.estimate
    rows = kept.rows.copy()
    _stand(estimator, 0.3, 0.3, 5.0, start=k)
    np.testing.assert_array_equal(kept.rows, rows)
    assert isinstance(kept, Estimates) and kept.stamp_ns == START_NS + (k - 1) * STEP_NS


# --- altitudes in any order -------------------------------------------------------------------------


def _delayed(altitude, imu, delay):
    """The same altitudes, each received ``delay`` s after its stamp."""
    arrival = np.searchsorted(imu.stamp_ns, altitude.stamp_ns + round(delay * 1e9), side="right")
    return AltitudeSeries(altitude.stamp_ns, altitude.altitude, arrival)


def _complete(altitude, imu, margin=1.0):
    """Leave out the altitudes that a delayed delivery would bring after the end."""
    kept = altitude.stamp_ns <= imu.stamp_ns[-1] - round(margin * 1e9)
    return AltitudeSeries(altitude.stamp_ns[kept], altitude.altitude[kept], altitude.arrival[kept])


@MODELS
@pytest.mark.parametrize("delay", [0.1, 0.23, 0.45])
def test_late_altitudes_end_in_the_state_of_altitudes_in_order(model, delay):
    imu = _recording().imu
    altitude = _complete(_recording().altitude, imu)
    params = AttitudeParams(estimator=model)
    in_order, late = AttitudeEstimator(params), AttitudeEstimator(params)
    prompt, _ = in_order.run(imu, _delayed(altitude, imu, 0.0))
    delayed, _ = late.run(imu, _delayed(altitude, imu, delay))
    assert late.faults == in_order.faults
    np.testing.assert_allclose(delayed.rows[-1], prompt.rows[-1], rtol=IN_ORDER, atol=IN_ORDER)
    assert not np.array_equal(prompt.rows[1000], delayed.rows[1000])


def test_out_of_order_altitudes_end_in_the_state_of_altitudes_in_order():
    imu = _recording().imu
    altitude = _complete(_recording().altitude, imu)
    order = np.arange(len(altitude)) ^ 1  # 1, 0, 3, 2, ...
    order = order[order < len(altitude)]
    swapped = AltitudeSeries(altitude.stamp_ns[order], altitude.altitude[order],
                             np.maximum.accumulate(altitude.arrival[order]))
    in_order, out_of_order = AttitudeEstimator(), AttitudeEstimator()
    one, _ = in_order.run(imu, altitude)
    other, _ = out_of_order.run(imu, swapped)
    assert out_of_order.faults == in_order.faults
    np.testing.assert_allclose(other.rows[-1], one.rows[-1], IN_ORDER, IN_ORDER)


def test_published_rows_are_not_revised_by_a_late_altitude():
    imu = _recording().imu
    altitude = _complete(_recording().altitude, imu)
    once, _ = AttitudeEstimator().run(imu, _delayed(altitude, imu, 0.3))
    cut = 1500
    until = _delayed(altitude, imu, 0.3)
    early = until.arrival <= cut
    shorter, _ = AttitudeEstimator().run(
        ImuSeries(imu.stamp_ns[:cut], imu.gyro_b[:cut], imu.accel_b[:cut]),
        AltitudeSeries(until.stamp_ns[early], until.altitude[early], until.arrival[early]))
    np.testing.assert_array_equal(once.rows[:cut], shorter.rows)


def test_an_altitude_beyond_the_buffer_is_counted_and_changes_nothing():
    estimator = AttitudeEstimator(AttitudeParams(altitude_buffer=0.5))
    k = _stand(estimator, seconds=5.0)
    twin = copy.deepcopy(estimator)
    assert not estimator.add_altitude(START_NS + (k - 53) * STEP_NS + 1, 20.0)
    assert estimator.faults.altitude_late == 1
    for e in (estimator, twin):
        _stand(e, seconds=0.1, start=k)
    np.testing.assert_array_equal(estimator.estimate.rows, twin.estimate.rows)


def test_an_altitude_just_inside_the_buffer_counts():
    estimator = AttitudeEstimator(AttitudeParams(altitude_buffer=0.5))
    k = _stand(estimator, seconds=5.0)
    assert estimator.add_altitude(START_NS + (k - 50) * STEP_NS + 1, 12.5)
    assert estimator.faults.altitude_late == 0


def test_an_altitude_ahead_of_the_imu_waits_for_it():
    waiting, in_time = AttitudeEstimator(), AttitudeEstimator()
    k = _stand(waiting, seconds=5.0)
    _stand(in_time, seconds=5.0)
    at = START_NS + (k + 3) * STEP_NS
    assert waiting.add_altitude(at, 12.3)
    before = waiting.estimate.altitude
    for j in range(k, k + 6):
        if j == k + 3:
            assert in_time.add_altitude(at, 12.3)
        for e in (waiting, in_time):
            e.add_imu(START_NS + j * STEP_NS, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
        if j < k + 3:
            assert waiting.estimate.altitude == pytest.approx(before, abs=1e-3)
    np.testing.assert_array_equal(waiting.estimate.rows, in_time.estimate.rows)
    assert waiting.estimate.altitude > before + 1e-3


def test_an_altitude_far_ahead_or_twice_is_refused_and_counted():
    estimator = AttitudeEstimator()
    k = _stand(estimator, seconds=5.0)
    assert not estimator.add_altitude(START_NS + (k + 200) * STEP_NS, 12.0)
    assert estimator.faults.altitude_ahead == 1
    assert not estimator.add_altitude(START_NS + (k - 5) * STEP_NS, 99.0)
    assert estimator.faults.altitude_duplicate == 1


def test_a_delay_that_is_told_is_taken_out():
    errors = AltimeterErrors(delay=0.15)
    recording = simulate("vertical_plane", duration=60.0, imu_rate=RATE, imu_errors=ImuErrors(),
                         altimeter_errors=errors)
    late = slice(30 * RATE, None)

    def altitude_error(delay):
        estimates, fresh = AttitudeEstimator(AttitudeParams(altitude_delay=delay)).run(
            recording.imu, recording.altitude)
        error = estimates.altitude + recording.position_n[fresh, 2]
        return np.sqrt(np.mean(error[late] ** 2))

    # An altitude that is 0.15 s old shows z = h(t - 0.15) = h + 0.15 vd.
    assert altitude_error(0.15) < 0.2 * altitude_error(0.0)


# --- time and parameters ----------------------------------------------------------------------------


@pytest.mark.parametrize("back_ns", [0, 1, 5_000_000_000])
def test_a_stamp_that_is_not_later_is_an_error_and_changes_nothing(back_ns):
    estimator = AttitudeEstimator()
    k = _stand(estimator, seconds=5.0)
    before = estimator.estimate.rows
    with pytest.raises(TimeJumpError, match="not later"):
        estimator.add_imu(START_NS + (k - 1) * STEP_NS - back_ns, np.ones(3), np.ones(3))
    np.testing.assert_array_equal(estimator.estimate.rows, before)
    _stand(estimator, seconds=0.1, start=k)


@MODELS
def test_a_sample_that_has_not_three_values_is_an_error(model):
    estimator = AttitudeEstimator(AttitudeParams(estimator=model))
    for gyro_b, accel_b in ((np.ones(2), np.ones(3)), (np.ones(3), np.ones(4))):
        with pytest.raises(ValueError, match=f"must have 3 values, got {len(gyro_b)} and {len(accel_b)}"):
            estimator.add_imu(START_NS, gyro_b, accel_b)
    assert estimator.faults == AttitudeEstimator().faults


def test_a_recording_with_a_jump_back_is_an_error_unless_told_to_reset_or_skip():
    imu = _recording().imu
    stamp_ns = imu.stamp_ns.copy()
    stamp_ns[1000:] -= 3_000_000_000
    jumped = ImuSeries(stamp_ns, imu.gyro_b, imu.accel_b)
    with pytest.raises(TimeJumpError):
        AttitudeEstimator().run(jumped)
    actions = np.zeros(len(imu), dtype=np.int64)
    actions[1000] = ACTION_RESET
    estimates, fresh = AttitudeEstimator().run(jumped, actions=actions)
    assert fresh.all() and estimates.valid[999] and not estimates.valid[1000]
    actions = np.zeros(len(imu), dtype=np.int64)
    actions[1000:1300] = ACTION_SKIP
    _, fresh = AttitudeEstimator().run(jumped, actions=actions)
    np.testing.assert_array_equal(fresh, actions != ACTION_SKIP)


def test_the_next_part_of_a_recording_may_not_begin_before_the_end_of_the_last():
    imu = _recording().imu
    estimator = AttitudeEstimator()
    estimator.run(imu)
    with pytest.raises(TimeJumpError):
        estimator.run(imu)


@MODELS
def test_reset_forgets_everything_but_the_counters(model):
    params = AttitudeParams(estimator=model)
    recording = _recording()
    used, new = AttitudeEstimator(params), AttitudeEstimator(params)
    used.run(recording.imu, recording.altitude)
    used.add_altitude(int(recording.imu.stamp_ns[-1]), math.nan)
    used.reset()
    assert used.faults.altitude_not_finite == 1 and not used.estimate.valid
    again, _ = used.run(recording.imu, recording.altitude)
    fresh, _ = new.run(recording.imu, recording.altitude)
    np.testing.assert_array_equal(again.rows, fresh.rows)


def test_new_parameters_keep_the_state_and_count_from_the_next_sample():
    estimator = AttitudeEstimator()
    k = _stand(estimator, 0.2, -0.1, 10.0)
    twin, before = copy.deepcopy(estimator), estimator.estimate.down_b
    estimator.params = AttitudeParams(gyro_noise_density=0.2)
    for e in (estimator, twin):
        _stand(e, 0.2, -0.1, 0.5, start=k)
    assert np.degrees(_angle(estimator.estimate.down_b, before)) < LEVEL_DEG
    noisy, quiet = (np.trace(e.estimate.tilt_covariance_n) for e in (estimator, twin))
    assert noisy > 2 * quiet


def test_gravity_is_that_of_the_latitude():
    assert AttitudeParams().local_gravity() == GRAVITY
    assert AttitudeParams(gravity=9.81).local_gravity() == 9.81
    assert AttitudeParams(latitude=1.0).local_gravity() == pytest.approx(normal_gravity(1.0))
    assert AttitudeParams(latitude=1.0, gravity=9.81).local_gravity() == 9.81


@pytest.mark.parametrize("latitude", [math.radians(70.0), math.radians(-70.0)])
def test_with_a_latitude_the_vertical_earth_rate_is_not_taken_for_a_gyro_bias(latitude):
    recording = simulate("hover", duration=120.0, rest=120.0, imu_rate=50.0, latitude=latitude,
                         imu_errors=ImuErrors(), altimeter_errors=AltimeterErrors())
    told, _ = AttitudeEstimator(AttitudeParams(latitude=latitude)).run(recording.imu, recording.altitude)
    untold, _ = AttitudeEstimator(AttitudeParams(gravity=normal_gravity(latitude))).run(
        recording.imu, recording.altitude)
    vertical = -EARTH_RATE * math.sin(latitude)
    assert untold.gyro_bias_b[-1, 2] == pytest.approx(vertical, rel=0.05)
    assert abs(told.gyro_bias_b[-1, 2]) < 0.05 * abs(vertical)


def test_before_the_first_sample_there_is_no_attitude_and_it_says_why():
    estimator = AttitudeEstimator()
    assert not estimator.estimate.valid
    assert "IMU" in estimator.waiting_for
    estimator.add_imu(START_NS, np.zeros(3), np.array([0.0, 0.0, -GRAVITY]))
    assert not estimator.estimate.valid
    assert "gravity" in estimator.waiting_for


def test_warming_up_leaves_no_trace():
    warmed, cold = AttitudeEstimator(), AttitudeEstimator()
    warmed.warm_up()
    for e in (warmed, cold):
        _stand(e, 0.1, 0.1, 2.0)
    np.testing.assert_array_equal(warmed.estimate.rows, cold.estimate.rows)
    assert warmed.faults == cold.faults
