"""The receiver of flight_with_gps: where the fixes are, how they scatter, when the sky is lost, how late they come."""

import numpy as np
import pytest

from inertial.earth import radii_of_curvature
from inertial.flight_scenarios import FLIGHT_SCENARIOS, HEIGHT, LONGITUDE, Receiver, simulate_flight
from inertial.table_scenarios import LATITUDE

DURATION, IMU_RATE = 100.0, 20.0
RECEIVER = Receiver()
SPREAD_SHARE = 0.2
"""Of a standard deviation found from 400 draws, five of its own."""
LAST_IMU_SAMPLE = 0.06  # s, between two samples at IMU_RATE


@pytest.fixture(scope="module")
def flight():
    return simulate_flight("flight_with_gps", duration=DURATION, imu_rate=IMU_RATE, seed=1)


def seconds(flight, series):
    return (series.stamp_ns - flight.truth.stamp_ns[0]) * 1e-9


def at(flight, series):
    """Return where in the truth a series' samples are."""
    place = np.searchsorted(flight.truth.stamp_ns, series.stamp_ns)
    assert (flight.truth.stamp_ns[place] == series.stamp_ns).all()
    return place


def test_fixes_scatter_about_the_truth_as_their_covariance_says(flight):
    fix, known = flight.fix, np.isfinite(flight.fix.latitude)
    meridian, transverse = radii_of_curvature(LATITUDE)
    position_n = np.stack([(fix.latitude - fix.latitude[0]) * (meridian + HEIGHT),
                           (fix.longitude - fix.longitude[0]) * (transverse + HEIGHT) * np.cos(LATITUDE),
                           fix.height[0] - fix.height], axis=1)[known]
    assert np.abs(position_n[0]).max() == 0.0, "the true position counts from the first fix"
    error_n = position_n - flight.position_n[at(flight, fix)][known]
    std = np.sqrt(np.diagonal(fix.covariance_n))
    np.testing.assert_allclose(error_n.std(axis=0), std, rtol=SPREAD_SHARE)
    np.testing.assert_allclose([fix.latitude[0], fix.longitude[0]], [LATITUDE, LONGITUDE], atol=1e-6)
    velocity = flight.velocity
    error_n = velocity.velocity_n - flight.velocity_n[at(flight, velocity)]
    np.testing.assert_allclose(error_n.std(axis=0), np.sqrt(np.diagonal(velocity.covariance_n)), rtol=SPREAD_SHARE)


def test_the_sky_is_lost_once_told_and_once_in_silence(flight):
    t, known = seconds(flight, flight.fix), np.isfinite(flight.fix.latitude)
    first, second = RECEIVER.dropout_start, RECEIVER.dropout_period + RECEIVER.dropout_start
    assert t[~known].min() >= first and t[~known].max() < first + RECEIVER.dropout_length
    assert (~known).sum() == round(RECEIVER.dropout_length * RECEIVER.rate)
    for each in (t, seconds(flight, flight.velocity)):
        assert not ((each >= second) & (each < second + RECEIVER.dropout_length)).any()
    assert not ((seconds(flight, flight.velocity) >= first)
                & (seconds(flight, flight.velocity) < first + RECEIVER.dropout_length)).any()


def test_fixes_arrive_late_by_their_delay(flight):
    for series, delay in ((flight.fix, RECEIVER.fix_delay), (flight.velocity, RECEIVER.velocity_delay)):
        last_ns = flight.imu.stamp_ns[series.arrival - 1]
        late = (series.stamp_ns - last_ns) * 1e-9 + delay
        assert (late >= 0.0).all() and late.max() < LAST_IMU_SAMPLE


def test_the_same_seed_gives_the_same_flight_and_another_one_another():
    short = {"duration": 10.0, "imu_rate": IMU_RATE}
    flights = [simulate_flight(name, seed=seed, **short) for name in FLIGHT_SCENARIOS for seed in (0, 0, 1)]
    np.testing.assert_array_equal(flights[0].fix.latitude, flights[1].fix.latitude)
    assert (flights[0].velocity.velocity_n != flights[2].velocity.velocity_n).all()
