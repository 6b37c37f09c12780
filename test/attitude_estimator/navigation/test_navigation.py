"""The navigator as a program sees it: flights with aids that come late, stop, lie or are not there."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from attitude_estimator.biases import start_with_biases
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.navigation.estimator import NavigationEstimator
from attitude_estimator.navigation.params import NavigationParams
from inertial.flight_scenarios import simulate_flight
from inertial.recording import VelocitySeries
from inertial.rotation import (
    dcm_from_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
)
from inertial.scoring import score_attitude
from inertial.simulator import simulate

IMU_RATE = 100.0
POSITION_STD, VELOCITY_STD = 1.0, 0.1  # m and m/s, each axis, of the simulated receiver
SETTLED = 25.0  # s, after which the heading is known and the biases are on their way
# RMS over a minute of one flight, half as much again as it is: attitude deg, velocity m/s, position m.
LIMITS = {"eskf15": (1.2, 0.25, 1.2), "cascade": (1.2, 0.35, 1.2)}
NEES_LOW, NEES_HIGH = 0.3, 2.0  # of 9 states, one flight's mean: correlated errors leave it loose
BEYOND = 4.0  # sigma
ROUNDING = 1e-9  # of the same steps in the same order

ESTIMATORS = tuple(LIMITS)


@cache
def _recording(scenario="turn", duration=60.0):
    return simulate(scenario, duration=duration, imu_rate=IMU_RATE)


@cache
def _aids(scenario="turn", rate=1.0, seed=1):
    """Return (sample, position, velocity) of a receiver, with its white noise."""
    recording, rng = _recording(scenario), np.random.default_rng(seed)
    step = round(IMU_RATE / rate)
    return tuple((k, recording.position_n[k] + POSITION_STD * rng.standard_normal(3),
                  recording.velocity_n[k] + VELOCITY_STD * rng.standard_normal(3))
                 for k in range(step // 2, len(recording.imu), step))


def _fly(params, recording, aids, delay=0, altitude=False):
    """Run a recording with aids that arrive `delay` samples late from SETTLED on; return all estimates."""
    estimator, imu = NavigationEstimator(params), recording.imu
    R_position, R_velocity = POSITION_STD**2 * np.eye(3), VELOCITY_STD**2 * np.eye(3)
    arriving = {k + delay * (k > SETTLED * IMU_RATE): (k, position_n, velocity_n) for k, position_n, velocity_n in aids}
    due = 0
    estimator.hold()
    for k in range(len(imu)):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        while altitude and due < len(recording.altitude) and recording.altitude.arrival[due] <= k + 1:
            estimator.add_altitude(int(recording.altitude.stamp_ns[due]), recording.altitude.altitude[due])
            due += 1
        if k in arriving:
            at, position_n, velocity_n = arriving[k]
            if position_n is not None:
                estimator.add_position(int(imu.stamp_ns[at]), position_n, R_position)
            if velocity_n is not None:
                estimator.add_velocity(int(imu.stamp_ns[at]), velocity_n, R_velocity)
    navigation, fresh = estimator.release()
    assert fresh.all()
    return navigation, estimator


@cache
def _usual(estimator):
    return _fly(NavigationParams(estimator=estimator), _recording(), _aids())


def _errors(recording, navigation):
    """Return the errors (N, 9) of attitude (navigation axes, rad), velocity and position."""
    q = quaternion_multiply(recording.truth.q_nb_wxyz, quaternion_conjugate(navigation.q_nb_wxyz))
    return np.concatenate([quaternion_log(q), recording.velocity_n - navigation.velocity_n,
                           recording.position_n - navigation.position_n], axis=-1)


def _seconds(navigation):
    return (navigation.stamp_ns - navigation.stamp_ns[0]) * 1e-9


def _rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=-1)))


def _nees(error, covariance):
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def _sigmas(error, covariance):
    return np.abs(error) / np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_flight_is_followed_and_its_covariance_is_honest(name):
    recording, (navigation, estimator) = _recording(), _usual(name)
    late = _seconds(navigation) > SETTLED
    error = _errors(recording, navigation)[late]
    assert navigation.navigating[late].all()
    attitude, velocity, position = LIMITS[name]
    assert np.degrees(_rms(error[:, :3])) < attitude
    assert _rms(error[:, 3:6]) < velocity
    assert _rms(error[:, 6:]) < position
    assert NEES_LOW < _nees(error, navigation.covariance[late]).mean() / 9 < NEES_HIGH
    assert estimator.health["fix"].refused == estimator.health["velocity"].refused == 0


@pytest.mark.parametrize("scenario", ["turn", "car", "quad"])
def test_an_unknown_heading_is_never_confidently_wrong(scenario):
    recording = _recording(scenario)
    navigation, _ = _fly(NavigationParams(), recording, _aids(scenario))
    known = navigation.heading_known
    assert not known[0] and known[-1]
    error, covariance = _errors(recording, navigation), navigation.covariance
    assert np.all(covariance[~known][:, 2, 2] >= np.pi**2 / 3)
    assert np.all(np.abs(error[known, 2]) < BEYOND * np.sqrt(covariance[known, 2, 2]))


def test_a_heading_that_is_told_starts_at_once():
    recording = _recording()
    estimator = NavigationEstimator()
    imu = recording.imu
    for k in range(len(imu)):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        if estimator.estimate.valid:
            break
    assert not estimator.estimate.heading_known and "heading" in estimator.waiting_for
    dcm_nb = dcm_from_quaternion(recording.truth.q_nb_wxyz[k])
    heading = np.arctan2(dcm_nb[1, 0], dcm_nb[0, 0])
    estimator.add_heading(int(imu.stamp_ns[k]), heading, 1e-3)
    estimator.add_velocity(int(imu.stamp_ns[k]), recording.velocity_n[k])
    estimator.add_imu(int(imu.stamp_ns[k + 1]), imu.gyro_b[k + 1], imu.accel_b[k + 1])
    assert estimator.estimate.navigating
    dcm_nb = dcm_from_quaternion(estimator.estimate.q_nb_wxyz)
    assert np.arctan2(dcm_nb[1, 0], dcm_nb[0, 0]) == pytest.approx(heading, abs=0.02)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_late_measurement_counts_as_one_in_time(name):
    recording, (in_time, _) = _recording(), _usual(name)
    late, estimator = _fly(NavigationParams(estimator=name), recording, _aids(), delay=30)
    # Between two arrivals, when both have had the same.
    same = np.arange(len(late)) % 100 == 99
    assert estimator.faults["measurement_late"] == 0
    settled = same & (_seconds(late) > SETTLED)
    np.testing.assert_allclose(late.rows[settled], in_time.rows[settled], rtol=ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_recording_at_once_is_its_samples_one_by_one(name):
    recording, params = simulate_flight("flight_with_gps", duration=30.0), NavigationParams(estimator=name)
    at_once, held = NavigationEstimator(params), NavigationEstimator(params)
    navigation, fresh = at_once.run(recording)
    one_by_one, rows = NavigationEstimator(params), []
    held.hold()
    for estimator in (one_by_one, held):
        for arrived in _in_order(recording):
            if arrived(estimator) and estimator is one_by_one:
                rows.append(estimator.estimate.rows)
    released, _ = held.release()
    assert fresh.all() and navigation.navigating[-1]
    for found in (navigation.rows, released.rows):
        np.testing.assert_allclose(found, rows, rtol=ROUNDING, atol=ROUNDING)
    for estimator in (at_once, held):
        assert estimator.health.keys() == one_by_one.health.keys() and estimator.origin == one_by_one.origin
        for name, health in one_by_one.health.items():
            assert dataclasses.astuple(estimator.health[name]) == pytest.approx(dataclasses.astuple(health),
                                                                               rel=ROUNDING, nan_ok=True)
        assert estimator.faults == one_by_one.faults and estimator.level_faults == one_by_one.level_faults
        np.testing.assert_allclose(estimator.estimate.rows, rows[-1], rtol=ROUNDING, atol=ROUNDING)


def _in_order(recording):
    """Yield what gives an estimator each sample, altitude, fix and velocity as it arrives; True for a new estimate."""
    imu, altitude, fix, velocity = recording.imu, recording.altitude, recording.fix, recording.velocity
    due = [(k, lambda e, i=i: e.add_altitude(int(altitude.stamp_ns[i]), altitude.altitude[i]) and False)
           for i, k in enumerate(altitude.arrival)]
    due += [(k, lambda e, i=i: e.add_fix(int(fix.stamp_ns[i]), fix.latitude[i], fix.longitude[i], fix.height[i],
                                         fix.covariance_n) and False)
            for i, k in enumerate(fix.arrival) if np.isfinite(fix.latitude[i])]
    due += [(k, lambda e, i=i: e.add_velocity(int(velocity.stamp_ns[i]), velocity.velocity_n[i],
                                              velocity.covariance_n) and False)
            for i, k in enumerate(velocity.arrival)]
    due += [(k + 0.5, lambda e, k=k: e.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k]))
            for k in range(len(imu))]
    for _, give in sorted(due, key=lambda event: event[0]):
        yield give


def test_a_reset_among_what_is_held_starts_anew():
    recording, estimator = _recording(), NavigationEstimator()
    imu = recording.imu
    for again in (False, True):
        estimator.hold()
        for k in range(2000):
            if again and k == 1000:
                estimator.reset()
            estimator.add_imu(int(imu.stamp_ns[k + 2000 * again]), imu.gyro_b[k], imu.accel_b[k])
            estimator.add_velocity(int(imu.stamp_ns[k + 2000 * again]), recording.velocity_n[k])
        navigation, fresh = estimator.release()
    assert navigation.navigating[fresh.sum() - 1001] and not navigation.navigating[fresh.sum() - 1000]


def test_what_is_late_counts_also_across_the_beginning_of_navigation():
    recording = simulate_flight("flight_with_gps", duration=30.0)
    estimator = NavigationEstimator()
    navigation, _ = estimator.run(recording)
    heard = np.isfinite(recording.fix.latitude).sum()
    assert navigation.navigating[-1] and not navigation.navigating[0]
    assert estimator.health["fix"].used == heard - 1  # the first gives the origin
    # What was valid at the very first sample came before it.
    assert estimator.faults["measurement_late"] <= 2


def test_aids_of_one_stamp_count_alike_in_either_order():
    recording, ends = _recording(duration=30.0), []
    imu = recording.imu
    for order in (1, -1):
        estimator = NavigationEstimator()
        for k in range(len(imu)):
            estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
            if k % 100 == 50:
                for add, value in ((estimator.add_position, recording.position_n[k]),
                                   (estimator.add_velocity, recording.velocity_n[k]))[::order]:
                    assert add(int(imu.stamp_ns[k - 10]), value)
        ends.append(estimator.estimate.rows)
    assert np.array_equal(*ends)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_biases_known_from_before_are_known_when_it_begins_to_navigate(name):
    recording, found = simulate_flight("flight_with_gps", duration=30.0), []
    for known in (False, True):
        estimator = NavigationEstimator(NavigationParams(estimator=name))
        if known:
            start_with_biases(estimator.level, recording.gyro_bias_b[0], np.full(3, 1e-4), recording.accel_bias_b[0],
                              np.full(3, 0.01))
        navigation, _ = estimator.run(recording)
        first = np.argmax(navigation.navigating)
        found.append((np.sqrt(navigation.gyro_bias_variance[first]),
                      np.abs(navigation.gyro_bias_b[first] - recording.gyro_bias_b[first])))
    (blind_std, _), (std, error) = found
    assert np.all(std < 0.5 * blind_std) and np.all(error < BEYOND * std)


def test_a_first_fix_far_off_is_neither_the_origin_nor_the_start():
    recording = simulate_flight("flight_with_gps", duration=30.0)
    latitude = recording.fix.latitude.copy()
    latitude[0] = 0.0
    fix = dataclasses.replace(recording.fix, latitude=latitude)
    estimator = NavigationEstimator()
    estimator.run(dataclasses.replace(recording, fix=fix))
    assert estimator.origin[0] == latitude[1] and estimator.health["fix"].refused == 0


def test_a_start_that_the_fixes_contradict_is_given_up():
    recording = _recording()
    aids = tuple((k, position_n + 200.0 * (k < 400), velocity_n) for k, position_n, velocity_n in _aids(rate=5.0))
    navigation, _ = _fly(NavigationParams(), recording, aids)
    late = _seconds(navigation) > SETTLED
    assert _rms(_errors(recording, navigation)[late, 6:]) < LIMITS["eskf15"][2]


def test_a_measurement_later_than_the_buffer_is_counted_and_refused():
    params = NavigationParams(measurement_buffer=0.1)
    _, estimator = _fly(params, _recording(), _aids(), delay=30)
    late = sum(k > SETTLED * IMU_RATE for k, *_ in _aids())
    assert estimator.faults["measurement_late"] == 2 * late
    assert estimator.health["fix"].used == len(_aids()) - late


def test_two_of_one_kind_and_stamp_are_one():
    aids = _aids()[:10]
    recording = _recording(duration=12.0)
    estimator, imu = NavigationEstimator(), recording.imu
    for k in range(len(imu)):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        for at, position_n, _ in aids:
            if at == k:
                assert estimator.add_position(int(imu.stamp_ns[k]), position_n)
                assert not estimator.add_position(int(imu.stamp_ns[k]), position_n + 1.0)
    assert estimator.faults["measurement_duplicate"] == len(aids)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_dropout_is_coasted_honestly_and_ended(name):
    recording = _recording()
    aids = tuple(aid for aid in _aids() if not 3500 <= aid[0] < 4500)
    navigation, estimator = _fly(NavigationParams(estimator=name), recording, aids)
    error = _errors(recording, navigation)
    t = _seconds(navigation)
    coasting, after = (t > 35.0) & (t < 45.0), t > 50.0
    assert navigation.navigating[coasting].all()
    sigma = np.sqrt(np.diagonal(navigation.covariance, axis1=1, axis2=2))
    assert np.linalg.norm(sigma[4490, 6:]) > 2 * np.linalg.norm(sigma[3490, 6:])
    assert _sigmas(error[coasting], navigation.covariance[coasting]).max() < BEYOND
    assert _rms(error[after, 6:]) < LIMITS[name][2]
    assert estimator.health["fix"].refused == 0


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_wrong_fix_is_refused(name):
    _, (usual, _) = _recording(), _usual(name)
    aids = tuple((k, position_n + (300.0 if k == 4050 else 0.0), velocity_n) for k, position_n, velocity_n in _aids())
    navigation, estimator = _fly(NavigationParams(estimator=name), _recording(), aids)
    assert estimator.health["fix"].refused == 1
    at = _seconds(navigation) > SETTLED
    assert np.abs(navigation.position_n[at] - usual.position_n[at]).max() < POSITION_STD


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_lasting_change_of_the_fixes_is_taken_in(name):
    recording = _recording()
    moved = np.array([200.0, -100.0, 30.0])
    aids = tuple((k, position_n + (moved if k >= 4000 else 0.0), velocity_n) for k, position_n, velocity_n in _aids())
    navigation, estimator = _fly(NavigationParams(estimator=name), recording, aids)
    assert 1 <= estimator.health["fix"].refused <= 4
    at = _seconds(navigation) > 50.0
    assert _rms((recording.position_n + moved - navigation.position_n)[at]) < 2 * LIMITS[name][2]
    assert np.degrees(_rms(_errors(recording, navigation)[at, :3])) < LIMITS[name][0]


@pytest.mark.parametrize("kind", ["fixes", "velocities"])
def test_one_kind_of_aid_is_enough(kind):
    recording = _recording()
    aids = tuple((k, position_n if kind == "fixes" else None, velocity_n if kind == "velocities" else None)
                 for k, position_n, velocity_n in _aids(rate=5.0))
    navigation, _ = _fly(NavigationParams(), recording, aids)
    late = _seconds(navigation) > SETTLED
    error = _errors(recording, navigation)[late]
    assert navigation.navigating[late].all()
    assert np.degrees(_rms(error[:, :2])) < LIMITS["eskf15"][0]
    assert _rms(error[:, 3:6]) < 2 * LIMITS["eskf15"][1]
    assert _sigmas(error[:, :6], navigation.covariance[late, :6, :6]).max() < BEYOND


def test_the_steady_gain_follows_a_flight():
    params = NavigationParams(estimator="cascade", gain="steady", accel_noise_density=0.3, fix_std=POSITION_STD)
    recording = _recording()
    navigation, _ = _fly(params, recording, _aids())
    late = _seconds(navigation) > SETTLED
    assert _rms(_errors(recording, navigation)[late, 6:]) < 3 * LIMITS["cascade"][2]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_without_aids_the_tilt_is_the_attitude_estimators(name):
    recording = _recording("car")
    navigation, _ = _fly(NavigationParams(estimator=name), recording, (), altitude=True)
    estimates, _ = AttitudeEstimator().run(recording.imu, recording.altitude)
    ours, level = (score_attitude(e.stamp_ns, e.q_nb_wxyz, covariance, e.valid, recording.truth)
                   for e, covariance in ((navigation, navigation.covariance[:, :2, :2]),
                                         (estimates, estimates.tilt_covariance_n)))
    assert not navigation.heading_known.any()
    assert ours.tilt_rms_deg == pytest.approx(level.tilt_rms_deg, rel=1e-3)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_after_aids_are_gone_for_good_the_tilt_stays(name):
    recording = simulate("turn", duration=180.0, imu_rate=50.0)
    imu, rng = recording.imu, np.random.default_rng(2)
    aided = np.arange(25, 30 * 50, 50)
    velocity_n = recording.velocity_n[aided] + 0.1 * rng.standard_normal((len(aided), 3))
    velocity = VelocitySeries(imu.stamp_ns[aided], velocity_n, 0.01 * np.eye(3), aided + 1)
    navigation, _ = NavigationEstimator(NavigationParams(estimator=name)).run(
        dataclasses.replace(recording, velocity=velocity))
    estimates, _ = AttitudeEstimator().run(imu, recording.altitude)
    late = _seconds(navigation) > 60.0
    assert navigation.valid[late].all()
    level = score_attitude(estimates.stamp_ns, estimates.q_nb_wxyz, estimates.tilt_covariance_n, estimates.valid,
                           recording.truth)
    assert np.degrees(_rms(_errors(recording, navigation)[late, :2])) < 1.5 * level.tilt_rms_deg


@pytest.mark.parametrize("name", ESTIMATORS)
def test_samples_that_are_not_finite_are_survived(name):
    recording = _recording()
    gyro_b, accel_b = recording.imu.gyro_b.copy(), recording.imu.accel_b.copy()
    gyro_b[3000:3005, 1], accel_b[4000:4010] = np.nan, np.inf
    broken = type(recording.imu)(recording.imu.stamp_ns, gyro_b, accel_b)
    flown = type(recording)(**{**vars(recording), "imu": broken})
    navigation, estimator = _fly(NavigationParams(estimator=name), flown, _aids())
    late = _seconds(navigation) > SETTLED
    assert np.isfinite(navigation.rows).all()
    assert estimator.level_faults.gyro_not_finite == 5 and estimator.level_faults.accel_not_finite == 10
    assert np.degrees(_rms(_errors(recording, navigation)[late, :3])) < 1.5 * LIMITS[name][0]


@pytest.mark.parametrize(("method", "value"), [
    ("add_position", (np.array([0.0, np.nan, 0.0]),)), ("add_velocity", (np.full(3, np.inf),)),
    ("add_velocity", (np.zeros(3), -np.eye(3))), ("add_fix", (2.0, 0.0, 0.0)), ("add_fix", (np.nan, 0.0, 0.0)),
    ("add_inclinometer", (np.zeros(3),)), ("add_heading", (np.nan,))])
def test_what_is_no_measurement_is_an_error(method, value):
    with pytest.raises(ValueError, match="finite|positive|place|direction"):
        getattr(NavigationEstimator(), method)(1, *value)


def test_a_gap_starts_anew_and_a_stamp_back_is_an_error():
    recording = _recording()
    imu, estimator = recording.imu, NavigationEstimator()
    for k in range(3000):
        estimator.add_imu(int(imu.stamp_ns[k]), imu.gyro_b[k], imu.accel_b[k])
        if k % 100 == 50:
            estimator.add_velocity(int(imu.stamp_ns[k]), recording.velocity_n[k])
    assert estimator.estimate.navigating
    estimator.add_imu(int(imu.stamp_ns[3300]), imu.gyro_b[3300], imu.accel_b[3300])
    assert estimator.faults["restarted"] == 1 and not estimator.estimate.navigating
    with pytest.raises(ValueError, match="not later"):
        estimator.add_imu(int(imu.stamp_ns[3200]), imu.gyro_b[3200], imu.accel_b[3200])


def test_fixes_are_metres_from_the_first():
    estimator = NavigationEstimator()
    for k in range(1, 202):
        estimator.add_imu(k * 10_000_000, np.zeros(3), np.array([0.0, 0.0, -9.8]))
        if k in (1, 51):
            estimator.add_fix(k * 10_000_000, np.radians(50.0), np.pi - 1e-6, 100.0)
    assert estimator.origin == (np.radians(50.0), np.pi - 1e-6, 100.0)
    estimator.add_fix(2_010_000_000, np.radians(50.0) + 1e-6, -np.pi + 1e-6, 100.0, np.eye(3) * 1e-8)
    estimator.add_imu(2_020_000_000, np.zeros(3), np.array([0.0, 0.0, -9.8]))
    # On the meridian and, across the date line, on the parallel; it seems to move on for another 10 ms.
    np.testing.assert_allclose(estimator.estimate.position_n[:2], [6.38, 8.22], rtol=0.01)
