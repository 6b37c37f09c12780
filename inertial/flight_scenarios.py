"""Flights with a satellite receiver beside IMU and altimeter, over the turning Earth.

The receiver gives position and velocity with white noise, as its messages say, and each some time after it was
valid. Now and then it loses the sky: it says so, or it falls silent.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from inertial.earth import radii_of_curvature
from inertial.imu_errors import find_profile
from inertial.recording import FixSeries, VelocitySeries
from inertial.simulator import add_errors, make_trajectory, sample_trajectory
from inertial.table_scenarios import LATITUDE

LONGITUDE, HEIGHT = np.radians(139.0), 40.0
"""Of the start with :data:`inertial.table_scenarios.LATITUDE`, rad and m above the ellipsoid."""


@dataclass(frozen=True)
class Receiver:
    """A satellite receiver; the defaults are an ordinary one.

    Attributes
    ----------
    rate : float, Hz
    position_std, velocity_std : (3,), m and m/s, NED
    fix_delay, velocity_delay : float, s
        How long after it was valid each arrives.
    dropout_period, dropout_start, dropout_length : float, s
        In each period the sky is lost once: in every other one the receiver says that it has no fix,
        in the others it is silent.
    """

    rate: float = 5.0
    position_std: tuple = (1.0, 1.0, 2.0)
    velocity_std: tuple = (0.1, 0.1, 0.15)
    fix_delay: float = 0.12
    velocity_delay: float = 0.14
    dropout_period: float = 60.0
    dropout_start: float = 25.0
    dropout_length: float = 12.0


@dataclass(frozen=True)
class FlightScenario:
    """A motion of :data:`inertial.scenarios.SCENARIOS` that carries a receiver."""

    description: str
    motion: str
    receiver: Receiver


FLIGHT_SCENARIOS = {
    "flight_with_gps": FlightScenario(
        "an aircraft in long turns with a satellite receiver at 5 Hz that loses the sky for 12 s every minute",
        "turn", Receiver()),
}


def simulate_flight(name, *, duration=120.0, imu_rate=200.0, altimeter_rate=20.0, profile="consumer", seed=0,
                    rest=3.0):
    """Return a simulated recording with fixes and velocities.

    Parameters
    ----------
    name : str
        Of :data:`FLIGHT_SCENARIOS`.
    duration, imu_rate, altimeter_rate, profile, seed, rest
        As for :func:`inertial.simulator.simulate`.

    Returns
    -------
    inertial.simulator.SimulatedRecording
        Its true position counts from the first fix.

    Raises
    ------
    ValueError
        Figures out of range.
    """
    scenario, sensors = FLIGHT_SCENARIOS[name], find_profile(profile)
    trajectory = make_trajectory(scenario.motion, duration=duration, rest=rest, latitude=LATITUDE)
    rng = np.random.default_rng(seed)
    recording = add_errors(sample_trajectory(trajectory, imu_rate=imu_rate), sensors.imu, sensors.altimeter, rng,
                           altimeter_rate=altimeter_rate)
    fix, velocity, first_error_n = _receive(recording, scenario.receiver, rng)
    return dataclasses.replace(recording, name=name, fix=fix, velocity=velocity,
                               position_n=recording.position_n - first_error_n)


def _receive(recording, receiver, rng):
    """Return fixes, velocities and the error of the first fix, m NED."""
    truth_ns = recording.truth.stamp_ns
    seconds = (truth_ns - truth_ns[0]) * 1e-9
    sampled = np.unique(np.searchsorted(seconds, np.arange(0.0, seconds[-1], 1.0 / receiver.rate)))
    lost, told = _lost_sky(seconds[sampled], receiver)
    heard = ~lost | told
    k, lost = sampled[heard], lost[heard]
    stamp_ns = truth_ns[k]
    noise = rng.standard_normal((2, len(k), 3))
    position_error_n = noise[0] * receiver.position_std
    north, east, down = (recording.position_n[k] + position_error_n).T
    meridian, transverse = radii_of_curvature(LATITUDE)
    fix = FixSeries(
        stamp_ns, np.where(lost, np.nan, LATITUDE + north / (meridian + HEIGHT)),
        np.where(lost, np.nan, LONGITUDE + east / ((transverse + HEIGHT) * np.cos(LATITUDE))),
        np.where(lost, np.nan, HEIGHT - down), np.diag(np.square(receiver.position_std)),
        _arrival(recording.imu.stamp_ns, stamp_ns, receiver.fix_delay))
    moving = ~lost
    velocity = VelocitySeries(
        stamp_ns[moving], (recording.velocity_n[k] + noise[1] * receiver.velocity_std)[moving],
        np.diag(np.square(receiver.velocity_std)),
        _arrival(recording.imu.stamp_ns, stamp_ns[moving], receiver.velocity_delay))
    return fix, velocity, position_error_n[0]


def _lost_sky(seconds, receiver):
    """Return where the sky is lost, and where the receiver tells so."""
    period, since = np.divmod(seconds, receiver.dropout_period)
    lost = (since >= receiver.dropout_start) & (since < receiver.dropout_start + receiver.dropout_length)
    return lost, lost & (period % 2 == 0)


def _arrival(imu_ns, stamp_ns, delay):
    return np.searchsorted(imu_ns, stamp_ns + round(delay * 1e9), side="right")
