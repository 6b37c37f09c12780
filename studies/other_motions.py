"""Motions that neither the scenarios nor the recordings have: feet, horses, trains, boats, a ball that is thrown.

Twenty-one kinds of motion, a few random draws of each, with consumer sensors. The tilt error of the default estimator
with and without its altimeter, whether its covariance knows, and that of VQF at its defaults. Nothing was tuned on one
of them alone. Writes docs/results/other_motions.md.

Each motion is drawn on a fine grid: where a sensor is (NED) and how it is turned. Sensors on that path are those of
:mod:`inertial.simulator`.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.earth import STANDARD_GRAVITY
from inertial.imu_errors import find_profile
from inertial.recording import AttitudeSeries, ImuSeries
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    down_from_quaternion,
    quaternion_conjugate,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
)
from inertial.scoring import score_attitude, tilt_error_n
from inertial.simulator import SampledTrajectory, add_errors
from studies.bench_accuracy import tilt_rms_deg
from studies.peers import installed_peers, run_peer

OUT = Path("docs/results/other_motions.md")
SECONDS, RATE, ALTIMETER_RATE, SEEDS = 150.0, 100, 20.0, (1, 2, 3)
SETTLE = 5.0  # s left out, as in every score
GRID_RATE = 1000  # Hz
START_NS = 1_700_000_000_000_000_000
T = np.arange(round(SECONDS * GRID_RATE) + 1) / GRID_RATE
WASH_AREA = 0.012  # m per (m/s)^2: pressure of the air that a hovering vehicle flies through
WASH_THRUST = 0.08  # m per m/s^2: pressure of its propellers' wash


@dataclass(frozen=True)
class Ride:
    """One draw of a motion, on the grid ``T``.

    Attributes
    ----------
    position_n : (N, 3), m
    q_nb_wxyz : (N, 4)
    shaking : (3,)
        Vibration of the mounting from 5 s on: m/s^2, rad/s, centre in Hz.
    wash : bool
        Whether the altimeter feels the air that the vehicle stirs.
    """

    position_n: np.ndarray
    q_nb_wxyz: np.ndarray
    shaking: tuple = (0.0, 0.0, 0.0)
    wash: bool = False


# --- functions of time ------------------------------------------------------------------------------


def _filtered(x, response):
    """Filter values on the grid by a response to frequency in Hz; their mirror image follows them."""
    mirrored = np.concatenate([x, x[-2:0:-1]])
    frequency = np.fft.rfftfreq(len(mirrored), 1.0 / GRID_RATE)
    return np.fft.irfft(np.fft.rfft(mirrored) * response(frequency), len(mirrored))[:len(x)]


def _smooth(x, time):
    """Smooth by a Gaussian whose standard deviation is ``time`` (s)."""
    return _filtered(x, lambda frequency: np.exp(-0.5 * (2 * np.pi * frequency * time) ** 2))


def _noise(rng, std, time):
    """Random function whose ups and downs take about ``time`` (s)."""
    x = _smooth(rng.standard_normal(len(T)), time)
    return std * x / x.std()


def _band(rng, std, frequency, width):
    """Random oscillation about a frequency, Hz."""
    x = _filtered(rng.standard_normal(len(T)), lambda f: np.exp(-0.5 * ((f - frequency) / width) ** 2))
    return std * x / x.std()


def _levels(rng, lasting, low, high, time):
    """Random levels, each held for ``lasting`` (s) on average, with smooth passages."""
    x = np.empty(len(T))
    k = 0
    while k < len(x):
        end = k + round((rng.exponential(lasting) + 0.3) * GRID_RATE)
        x[k:end] = rng.uniform(low, high)
        k = end
    return _smooth(x, time)


def _ramp(start, length=2.0):
    """From 0 to 1 within ``length`` (s), with two vanishing derivatives at both ends."""
    u = np.clip((T - start) / length, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u)


def _integral(x):
    return np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1]))]) / GRID_RATE


def _derivative(x):
    return np.gradient(x, 1.0 / GRID_RATE, axis=0)


def _attitude(roll, pitch, heading):
    return quaternion_from_dcm(dcm_nb_from_euler(roll, pitch, heading))


def _path(speed, turn_rate, slope=0.0):
    """Return position and heading of something that moves where it heads."""
    heading = _integral(turn_rate)
    level = speed * np.cos(slope)
    velocity_n = np.stack([level * np.cos(heading), level * np.sin(heading), -speed * np.sin(slope) + 0 * T], -1)
    return np.stack([_integral(component) for component in velocity_n.T], -1), heading


def _moved(position_n, north=0.0, east=0.0, down=0.0):
    return position_n + np.stack(np.broadcast_arrays(north, east, down), -1)


def _carried(position_n, q_nb_wxyz, lever_b):
    """Return the position of a point at a lever arm."""
    return position_n + dcm_from_quaternion(q_nb_wxyz) @ np.asarray(lever_b)


def _lean(speed, turn_rate):
    """Bank of a coordinated turn."""
    return np.arctan(speed * turn_rate / STANDARD_GRAVITY)


# --- people and animals -----------------------------------------------------------------------------


def _phone_in_hand(rng):
    on = _ramp(5)
    q = _attitude(0.3 * on * _noise(rng, 1, 0.5) + 0.2 * _levels(rng, 6, -1, 1, 0.3),
                  0.6 + _noise(rng, 0.3, 0.6) + _levels(rng, 8, -0.5, 0.5, 0.3), _noise(rng, 1, 1))
    return Ride(on[:, None] * np.stack([_noise(rng, std, 0.3) for std in (0.12, 0.12, 0.08)], -1), q)


def _phone_in_swinging_arm(rng):
    on, stride = _ramp(6), 2 * np.pi * 0.95 * T + _noise(rng, 0.3, 2)
    p, heading = _path(1.4 * on, on * _levels(rng, 8, -0.3, 0.3, 1))
    q = _attitude(_noise(rng, 0.1, 1), 0.45 * on * np.sin(stride) + 0.4, heading + 0.08 * on * np.sin(stride))
    return Ride(_carried(_moved(p, down=-0.03 * on * np.cos(2 * stride)), q, [0.1, 0, 0.55]), q)


def _foot(rng):
    on, steps = _ramp(6), T / 1.1
    swing = np.clip((steps % 1 - 0.55) / 0.45, 0, 1)
    stepped = np.floor(steps) + swing**3 * (10 - 15 * swing + 6 * swing**2)
    heading = _integral(on * _levels(rng, 8, -0.25, 0.25, 1))
    speed = on * _smooth(1.35 * _derivative(stepped), 0.01)
    p = np.stack([_integral(speed * np.cos(heading)), _integral(speed * np.sin(heading)),
                  -on * _smooth(0.12 * np.sin(np.pi * swing) ** 2, 0.012)], -1)
    pitch = -0.9 * np.sin(np.pi * swing) * np.sin(2 * np.pi * swing)
    return Ride(p, _attitude(0.1 * on * _smooth(np.sin(np.pi * swing), 0.015), on * _smooth(pitch, 0.015), heading))


def _head(rng):
    on, stride = _ramp(5), 2 * np.pi * 1.9 * T + _noise(rng, 0.4, 2)
    p, heading = _path(1.4 * on, on * _levels(rng, 6, -0.4, 0.4, 0.8))
    q = _attitude(0.03 * on * np.sin(stride / 2) + _noise(rng, 0.05, 0.5),
                  0.04 * on * np.sin(stride) + _levels(rng, 4, -0.5, 0.3, 0.15),
                  heading + _levels(rng, 3, -1, 1, 0.15))
    p = _moved(p, east=0.02 * on * np.cos(stride / 2), down=0.03 * on * np.cos(stride))
    return Ride(_carried(p, q, [0.1, 0, -0.15]), q)


def _horse(rng):
    on, stride = _ramp(5, 4), 2 * np.pi * 1.9 * T + _noise(rng, 0.5, 2)
    p, heading = _path(5 * on, on * _levels(rng, 8, -0.3, 0.3, 1))
    q = _attitude(0.05 * on * np.sin(stride / 2) + _noise(rng, 0.03, 1),
                  0.12 * on * np.sin(stride + 0.6) + _noise(rng, 0.05, 1), heading)
    return Ride(_moved(p, north=0.04 * on * np.sin(stride), down=0.08 * on * np.cos(stride)), q)


def _playground_swing(rng):
    del rng
    rope, on = 3.0, _ramp(4, 15)
    angle = 0.7 * on * np.sin(0.97 * np.sqrt(STANDARD_GRAVITY / rope) * T)
    return Ride(rope * np.stack([-np.sin(angle), 0 * T, np.cos(angle)], -1), _attitude(0.0, angle, 0.0))


# --- on wheels and rails ----------------------------------------------------------------------------


def _bicycle(rng):
    on = _ramp(5, 6)
    speed, turn_rate = on * (6 + _noise(rng, 1.5, 4)), on * _levels(rng, 8, -0.45, 0.45, 0.5)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.04, 8))
    q = _attitude(_lean(speed, turn_rate) + 0.03 * on * np.sin(2 * np.pi * 1.3 * T), _noise(rng, 0.04, 8), heading)
    return Ride(_moved(_carried(p, q, [0, 0, -0.9]), down=0.001 * on * _band(rng, 1, 12, 3)), q)


def _motorcycle(rng):
    on = _ramp(5, 8)
    speed, turn_rate = on * (22 + 6 * _levels(rng, 10, -1, 1, 2)), on * _levels(rng, 9, -0.38, 0.38, 0.8)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.03, 8))
    q = _attitude(_lean(speed, turn_rate), _noise(rng, 0.03, 8) - 0.01 * _derivative(speed), heading)
    return Ride(_carried(p, q, [0, 0, -0.7]), q, shaking=(2.0, 0.02, 70.0))


def _car_in_town(rng):
    speed = np.maximum(_smooth(12.0 * (_levels(rng, 9, -0.5, 1, 0.05) > 0), 1.6), 0) * _ramp(4)
    limit = 4 / np.maximum(speed, 1)  # 4 m/s^2 sideways
    turn_rate = _smooth(np.clip(speed * _levels(rng, 6, -0.07, 0.07, 0.8), -limit, limit), 0.3) * speed / (speed + 0.5)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.03, 4))
    q = _attitude(-0.007 * speed * turn_rate, _noise(rng, 0.03, 4) + 0.005 * _derivative(speed), heading)
    return Ride(p, q, shaking=(0.4, 0.004, 30.0))


def _motorway(rng):
    speed = (30 * _ramp(5, 14) + 5 * _levels(rng, 15, -1, 1, 3) * _ramp(30, 10)
             - 28 * _ramp(110, 8) + 25 * _ramp(122, 10))
    turn_rate = speed * _levels(rng, 20, -1 / 600, 1 / 600, 3)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.03, 8))
    q = _attitude(-0.007 * speed * turn_rate + _noise(rng, 0.004, 0.3),
                  _noise(rng, 0.03, 8) + 0.005 * _derivative(speed) + _noise(rng, 0.004, 0.3), heading)
    return Ride(_moved(p, down=0.005 * _ramp(5, 5) * _band(rng, 1, 1.4, 0.4)), q, shaking=(0.5, 0.005, 35.0))


def _off_road(rng):
    on = _ramp(5, 4)
    speed = on * (8 + 3 * _levels(rng, 6, -1, 1, 1))
    turn_rate = 0.07 * speed * _levels(rng, 5, -1, 1, 0.6)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.1, 2))
    q = _attitude(_noise(rng, 0.08, 0.5) + 0.04 * on * _band(rng, 1, 1.7, 0.5) - 0.01 * speed * turn_rate,
                  _noise(rng, 0.1, 2) + 0.04 * on * _band(rng, 1, 2, 0.6), heading + 0.01 * on * _band(rng, 1, 3, 1))
    bumps = on * (_band(rng, 0.05, 2, 0.5) + _band(rng, 0.004, 9, 3))
    return Ride(_moved(_carried(p, q, [0.5, 0.3, -0.5]), down=bumps), q, shaking=(3.0, 0.03, 55.0))


def _train(rng):
    speed, running = 60 * (_ramp(8, 50) - 0.7 * _ramp(100, 40)), _ramp(8, 5)
    turn_rate = speed * _levels(rng, 25, -1 / 900, 1 / 900, 3)
    p, heading = _path(speed, turn_rate, _noise(rng, 0.01, 10))
    q = _attitude(np.clip(0.6 * _lean(speed, turn_rate), -0.12, 0.12) + 0.004 * running * _band(rng, 1, 0.8, 0.2),
                  _noise(rng, 0.01, 10), heading)
    p = _moved(_carried(p, q, [0, 0, -1.5]), down=0.003 * running * _band(rng, 1, 1.5, 0.4))
    return Ride(p, q, shaking=(0.3, 0.003, 40.0))


def _roundabout(rng):
    """A car that drives round and round, level: 2 m/s^2 sideways for two minutes."""
    del rng
    speed = 6 * (_ramp(8, 6) - _ramp(120, 8))
    p, heading = _path(speed, speed / 18)
    return Ride(p, _attitude(0.0, 0.0, heading))


# --- on water and in the air ------------------------------------------------------------------------


def _boat(rng):
    on = _ramp(4, 8)
    roll, pitch = on * _band(rng, 0.18, 0.125, 0.02), on * _band(rng, 0.06, 0.17, 0.03)
    p, heading = _path(5 * on, on * _noise(rng, 0.03, 8) + _band(rng, 0.01, 0.12, 0.03))
    p = _moved(p, on * _band(rng, 0.4, 0.15, 0.03), on * _band(rng, 0.5, 0.12, 0.03), on * _band(rng, 0.7, 0.15, 0.025))
    q = _attitude(roll, pitch, heading)
    return Ride(_carried(p, q, [3, 1, -4]), q)


def _speedboat(rng):
    on = _ramp(5, 6)
    speed, turn_rate = on * (14 + _noise(rng, 2, 5)), on * _levels(rng, 10, -0.35, 0.35, 1)
    p, heading = _path(speed, turn_rate)
    q = _attitude(0.6 * _lean(speed, turn_rate) + 0.06 * on * _band(rng, 1, 0.6, 0.2),
                  on * (0.08 + _band(rng, 0.05, 0.7, 0.15)), heading)
    p = _moved(p, down=on * (_band(rng, 0.25, 0.7, 0.15) + _band(rng, 0.02, 3, 1)))
    return Ride(_carried(p, q, [1, 0, -1]), q, shaking=(1.5, 0.01, 60.0))


def _loiter(rng):
    """An aircraft that circles at 30 deg of bank in rough air."""
    on = _ramp(3, 8)
    speed = on * (18 + _noise(rng, 1, 4))
    turn_rate = _ramp(6, 6) * (STANDARD_GRAVITY * np.tan(np.radians(30)) / 18 + _noise(rng, 0.02, 2))
    p, heading = _path(speed, turn_rate, on * _noise(rng, 0.03, 3))
    q = _attitude(_lean(speed, turn_rate) + on * _noise(rng, 0.03, 0.7), 0.05 + on * _noise(rng, 0.03, 1), heading)
    return Ride(p, q, shaking=(1.0, 0.01, 90.0))


def _slow_loiter(rng):
    """An aircraft in one turn of 15 deg of bank for two minutes."""
    on = _ramp(3, 10)
    speed, turn_rate = 30 * on, _ramp(8, 8) * STANDARD_GRAVITY * np.tan(np.radians(15)) / 30
    p, heading = _path(speed, turn_rate, on * _noise(rng, 0.015, 5))
    return Ride(p, _attitude(_lean(speed, turn_rate) + _noise(rng, 0.01, 0.7), 0.03 + _noise(rng, 0.01, 1), heading))


def _multirotor_in_wind(rng):
    """It leans against its drag, and its propellers' wash is in the altimeter."""
    on = _ramp(5, 3)
    north, east = (on * _levels(rng, 8, -8, 8, 1.2) for _ in range(2))
    up, heading = on * _levels(rng, 10, -1.5, 1.5, 1), _integral(on * _levels(rng, 8, -0.5, 0.5, 0.5))
    drag = 0.35  # 1/s
    thrust_n = np.stack([_derivative(north) + drag * north, _derivative(east) + drag * east,
                         -_derivative(up) - STANDARD_GRAVITY], -1)
    z = -thrust_n / np.linalg.norm(thrust_n, axis=1, keepdims=True)
    y = np.cross(z, np.stack([np.cos(heading), np.sin(heading), 0 * T], -1))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    q = quaternion_from_dcm(np.stack([np.cross(y, z), y, z], -1))
    p = np.stack([_integral(north), _integral(east), -_integral(up)], -1)
    return Ride(p, q, shaking=(4.0, 0.03, 95.0), wash=True)


# --- machines and things ----------------------------------------------------------------------------


def _robot_arm(rng):
    joints = _ramp(4) * np.stack([_levels(rng, 4, -1, 1, 0.25) for _ in range(5)])
    q, p = _attitude(0.0, 0.0, 1.2 * joints[0]), np.zeros((len(T), 3))
    for turn, arm_b in ((_attitude(0.0, 0.6 * joints[1], 0.0), [0, 0, -0.5]),
                        (_attitude(0.0, 0.9 * joints[2], 0.0), [0.5, 0, 0]),
                        (_attitude(1.2 * joints[3], joints[4], 0.0), [0.12, 0, 0])):
        q = quaternion_multiply(q, turn)
        p = _carried(p, q, arm_b)
    return Ride(p, q)


def _lift(rng):
    up, start, side = 0.0, 8.0, 1
    while start < SECONDS - 20:
        ride, speed = rng.uniform(4, 12), rng.uniform(1.5, 5)
        up += side * speed * (_ramp(start, speed) - _ramp(start + ride, speed))
        start, side = start + ride + rng.uniform(8, 15), -side
    q = _attitude(0.05 + _noise(rng, 0.02, 2), 0.4 + _noise(rng, 0.03, 2), _noise(rng, 0.2, 3))
    return Ride(_moved(np.zeros((len(T), 3)), down=-_integral(up)), q)


def _ball(rng):
    """Turned in every direction, thrown about a little."""
    on = _ramp(4, 4)[:, None]
    q = [1.0, 0.0, 0.0, 0.0] + 1.5 * on * np.stack([_noise(rng, 1, 0.7) for _ in range(4)], -1)
    return Ride(on * np.stack([_noise(rng, 0.25, 0.35) for _ in range(3)], -1),
                q / np.linalg.norm(q, axis=1, keepdims=True))


MOTIONS = {
    "phone in the hand": _phone_in_hand,
    "phone in a swinging arm": _phone_in_swinging_arm,
    "foot": _foot,
    "head": _head,
    "horse": _horse,
    "playground swing": _playground_swing,
    "bicycle": _bicycle,
    "motorcycle": _motorcycle,
    "car in town": _car_in_town,
    "car on a motorway": _motorway,
    "car off the road": _off_road,
    "car round a roundabout": _roundabout,
    "train": _train,
    "boat": _boat,
    "speedboat": _speedboat,
    "aircraft loitering at 30 deg": _loiter,
    "aircraft loitering at 15 deg": _slow_loiter,
    "multirotor in wind": _multirotor_in_wind,
    "robot arm": _robot_arm,
    "lift": _lift,
    "ball": _ball,
}


# --- sensors and scores -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """All draws of a motion: RMS and largest tilt error in deg, NEES/2, share beyond 3 sigma or without attitude."""

    rms_deg: float
    worst_deg: float
    half_nees: float
    beyond: float


def record(name, seed):
    """Return one draw of a motion as consumer sensors record it, a SimulatedRecording."""
    rng = np.random.default_rng([seed, *name.encode()])
    ride, profile = MOTIONS[name](rng), find_profile("consumer")
    sampled = _sample(name, ride, rng)
    recording = add_errors(sampled, profile.imu, profile.altimeter, rng, altimeter_rate=ALTIMETER_RATE)
    return replace(recording, altitude=_washed(recording.altitude, sampled)) if ride.wash else recording


def _sample(name, ride, rng):
    """Return what perfect sensors see: means of the grid's intervals over those of the IMU."""
    q, velocity_n = ride.q_nb_wxyz, _derivative(ride.position_n)
    gyro_b = quaternion_log(quaternion_multiply(quaternion_conjugate(q[:-1]), q[1:])) * GRID_RATE
    force_n = _derivative(velocity_n) - [0.0, 0.0, STANDARD_GRAVITY]
    accel_b = np.einsum("nji,nj->ni", dcm_from_quaternion(q), force_n)
    accel, gyro, frequency = ride.shaking
    if frequency > 0.0:
        shaken = (_ramp(5, 3) * [_band(rng, 1, frequency, 8) for _ in range(6)]).T
        accel_b = accel_b + accel * shaken[:, :3]
        gyro_b = gyro_b + gyro * np.diff(shaken[:, 3:], axis=0) * GRID_RATE / (2 * np.pi * frequency)
    each = GRID_RATE // RATE
    ends = np.arange(each, len(T), each)
    stamp_ns = START_NS + np.arange(len(ends)) * (10**9 // RATE)
    means = (values.reshape(len(ends), each, 3).mean(axis=1) for values in (gyro_b, 0.5 * (accel_b[1:] + accel_b[:-1])))
    return SampledTrajectory(name, ImuSeries(stamp_ns, *means), AttitudeSeries(stamp_ns, q[ends]), velocity_n[ends],
                             ride.position_n[ends] - ride.position_n[0], STANDARD_GRAVITY)


def _washed(altitude, sampled):
    """Return altitudes with the pressure of the air that a multirotor flies through and stirs."""
    k = np.clip(np.searchsorted(sampled.imu.stamp_ns, altitude.stamp_ns), 0, len(sampled.imu) - 1)
    airspeed2 = np.sum(sampled.velocity_n[k, :2] ** 2, axis=1)
    thrust = -sampled.imu.accel_b[k, 2] - STANDARD_GRAVITY
    return replace(altitude, altitude=altitude.altitude - WASH_AREA * airspeed2 + WASH_THRUST * thrust)


def judge(recordings, use_altitude):
    """Return the :class:`Outcome` of the default estimator on the draws of a motion."""
    scores, worst = [], []
    for recording in recordings:
        estimates, _ = AttitudeEstimator(AttitudeParams()).run(
            recording.imu, recording.altitude if use_altitude else None)
        scores.append(score_attitude(estimates.stamp_ns, estimates.q_nb_wxyz, estimates.tilt_covariance_n,
                                     estimates.valid, recording.truth))
        k = np.searchsorted(recording.truth.stamp_ns, estimates.stamp_ns)
        error = tilt_error_n(estimates.q_nb_wxyz, down_from_quaternion(recording.truth.q_nb_wxyz[k]))
        used = estimates.valid & (estimates.stamp_ns - estimates.stamp_ns[0] >= SETTLE * 1e9)
        worst.append(np.degrees(np.linalg.norm(error[used], axis=1).max()))
    return Outcome(float(np.sqrt(np.mean([score.tilt_rms_deg**2 for score in scores]))), max(worst),
                   float(np.mean([score.nees for score in scores])) / 2,
                   1.0 - float(np.mean([score.coverage_3sigma for score in scores])))


def vqf_rms_deg(recordings):
    """Return VQF's tilt RMS on the draws of a motion; NaN where it is not installed."""
    vqf = installed_peers().get("vqf")
    if vqf is None:
        return np.nan
    return float(np.sqrt(np.mean([tilt_rms_deg(run_peer(vqf, one.imu), one) ** 2 for one in recordings])))


def report(rows):
    """Return the page, from name -> (with altitude, without, VQF's tilt RMS)."""
    lines = [
        "# Other motions", "",
        f"Made by `make study`. Motions that neither the scenarios nor the recordings have, {len(SEEDS)} random draws "
        f"of each, {SECONDS:g} s at {RATE} Hz, consumer sensors, {ALTIMETER_RATE:g} Hz of altitude; default "
        "parameters, cold start. Tilt RMS and the largest error in degrees after the first 5 s, NEES/2 (1 is exact, "
        "below it the filter is careful), the share beyond 3 sigma or without an attitude. VQF has no altimeter.", "",
        "| | with altitude | worst | NEES/2 | beyond | without | worst | NEES/2 | beyond | VQF |",
        f"|---|{'---|' * 9}"]
    for name, (aided, alone, vqf) in rows.items():
        cells = [f"{o.rms_deg:.2f} | {o.worst_deg:.1f} | {o.half_nees:.2f} | {o.beyond:.1%}" for o in (aided, alone)]
        lines.append(f"| {name} | {' | '.join(cells)} | {vqf:.2f} |")
    ratios = [np.exp(np.mean([np.log(row[k].rms_deg / row[2]) for row in rows.values()])) for k in (0, 1)]
    lines += ["", f"Geometric mean of the ratios to VQF: {ratios[0]:.2f} with altitude, {ratios[1]:.2f} without.", ""]
    return "\n".join(lines)


def main():
    """Run the study and write its page."""
    rows = {}
    for name in MOTIONS:
        recordings = [record(name, seed) for seed in SEEDS]
        rows[name] = judge(recordings, True), judge(recordings, False), vqf_rms_deg(recordings)
        print(".", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(report(rows))
    print(OUT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
