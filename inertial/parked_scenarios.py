"""Scenarios of a vehicle that stands parked on the turning Earth, for four grades of sensors.

It does not stand quite still. Wind rocks the sprung body, sinusoids about its resonance of 1 Hz; people walk
in it for some seconds now and then, and the body leans otherwise afterwards. The IMU sits above the axes of
that rocking and moves with it. The truth is the attitude of the IMU, sway included.

A name is ``parked_<grade>``, with the end ``_two_position`` (the IMU, or the vehicle with it, is turned by half a
turn in the middle), ``_rotating`` (it turns at 6 deg/s after half a minute, a turn one way, a turn the other) or
``_moved`` (in the middle the vehicle drives off and parks elsewhere, on other ground with another heading).

The grade ``adis`` has the ADIS16488A's figures of paper 002, table 1, turn-on biases among them. Its output noise
and noise density are the random walk seen at high frequencies and do not count twice; its nonlinearity, a share of
the full scale, is a parabola's there.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from inertial.earth import STANDARD_GRAVITY, normal_gravity
from inertial.imu_errors import ImuErrors, apply_imu_errors, find_profile
from inertial.recording import AttitudeSeries, ImuSeries
from inertial.rotation import dcm_nb_from_euler
from inertial.simulator import SimulatedRecording, Trajectory, sample_trajectory
from inertial.table_scenarios import HEADING, LATITUDE, PITCH, ROLL, TableMotion
from inertial.trajectory import Motion, Profile

START = 30.0
"""Seconds at rest before an IMU begins to rotate."""
MOVE = 20.0
"""Seconds of a drive to another place."""

_DEG = math.pi / 180
_DEG_PER_HOUR = _DEG / 3600
_DEG_PER_ROOT_HOUR = _DEG / 60
_PER_ROOT_HOUR = 1 / 60
_MILLI_G = 1e-3 * STANDARD_GRAVITY
_TRUTH_PERIOD = 0.1  # s

_HALF_TURN, _RAMP = 10.0, 1.0  # s, of a half turn and of each change of rate
_ROTATION_RATE = 6.0 * _DEG
_DRIVE_SPEED = 8.0
_DRIVE_ANGLES = np.array([-3.0, 2.0, 70.0]) * _DEG  # by which roll, pitch and heading differ afterwards

_LEVER = np.array([0.5, 0.0, -1.0])  # m, the IMU from the axes of the rocking, FRD
_WIND_STD = np.array([3e-4, 1.5e-4, 3e-5])  # rad, about x, y, z
_WIND_BAND, _WIND_LINES = (0.5, 2.0), 16  # Hz
_RESONANCE, _DAMPING = 1.0, 0.15  # Hz, and of the body on its springs
_LEAN_STD = np.array([8e-4, 4e-4, 0.0])  # rad
_STEP_AMPLITUDE, _STEP_RATE = np.array([4e-4, 2e-4, 3e-5]), 1.9  # rad, Hz
_WALK, _PAUSE = 6.0, 40.0  # s, each walk and the mean time between two


@dataclass(frozen=True)
class ParkedGrade:
    """A grade of sensors.

    Attributes
    ----------
    description : str
    errors : inertial.imu_errors.ImuErrors
    gyro_curvature : float, s/rad
        Nonlinearity: the factor of the square of the rate in the reading.
    accel_curvature : float, s^2/m
    """

    description: str
    errors: ImuErrors
    gyro_curvature: float = 0.0
    accel_curvature: float = 0.0


_ADIS = find_profile("adis16488a").imu
GRADES = {
    "perfect": ParkedGrade("perfect sensors", ImuErrors()),
    "navigation": ParkedGrade(
        "navigation-grade sensors (0.01 deg/h, 0.002 deg/rt-h, 0.05 mg)",
        ImuErrors(gyro_noise_density=0.002 * _DEG_PER_ROOT_HOUR, gyro_bias_std=0.01 * _DEG_PER_HOUR,
                  gyro_bias_instability=0.002 * _DEG_PER_HOUR, gyro_scale_std=1e-5,
                  gyro_misalignment_std=2e-5, accel_noise_density=0.003 * _PER_ROOT_HOUR,
                  accel_bias_std=0.05 * _MILLI_G, accel_bias_instability=0.005 * _MILLI_G,
                  accel_scale_std=5e-5, accel_misalignment_std=2e-5)),
    "tactical": ParkedGrade(
        "tactical-grade sensors (1 deg/h, 0.1 deg/rt-h, 1 mg)",
        ImuErrors(gyro_noise_density=0.1 * _DEG_PER_ROOT_HOUR, gyro_bias_std=1.0 * _DEG_PER_HOUR,
                  gyro_bias_instability=0.2 * _DEG_PER_HOUR, gyro_scale_std=3e-4,
                  gyro_misalignment_std=3e-4, accel_noise_density=0.03 * _PER_ROOT_HOUR,
                  accel_bias_std=_MILLI_G, accel_bias_instability=0.05 * _MILLI_G,
                  accel_scale_std=3e-4, accel_misalignment_std=3e-4)),
    "adis": ParkedGrade(
        "an ADIS16488A (0.2 deg/s and 16 mg at turn-on, 5.1 deg/h in the run, 0.26 deg/rt-h)",
        _ADIS, 1e-4 / _ADIS.gyro_range, 1e-3 / _ADIS.accel_range),
}
"""Name -> sensors."""


@dataclass(frozen=True)
class ParkedScenario:
    """A parked vehicle.

    Attributes
    ----------
    description : str
    grade : ParkedGrade
    scheme : str
        One of ``static``, ``two_position``, ``rotating``, ``moved``.
    """

    description: str
    grade: ParkedGrade
    scheme: str


_SCHEMES = {"static": "parked vehicle at latitude 35 deg, wind and people, {}",
            "two_position": "likewise, turned by 180 deg in the middle",
            "rotating": "likewise, an IMU that rotates at 6 deg/s, to and fro",
            "moved": "likewise, moved to another place in the middle"}
PARKED_SCENARIOS = {
    f"parked_{name}" + f"_{scheme}" * (scheme != "static"):
        ParkedScenario(text.format(grade.description), grade, scheme)
    for (name, grade), (scheme, text) in itertools.product(GRADES.items(), _SCHEMES.items())}
"""Name -> scenario: each grade standing still, turned half-way, rotating, moved."""


def simulate_parked(scenario, *, duration=300.0, imu_rate=100.0, seed=0, latitude=LATITUDE, heading=HEADING,
                    disturbance=1.0):
    """Return a simulated recording of a parked vehicle; the same arguments give the same bytes.

    Parameters
    ----------
    scenario : str
        A name in :data:`PARKED_SCENARIOS`.
    duration : float, s
    imu_rate : float, Hz
    seed : int
        Of the noise, the wind and the people.
    latitude : float, rad
    heading : float, rad
        Of the vehicle at the start, clockwise from true north.
    disturbance : float
        Strength of wind and people: 1 is usual, 0 none.

    Returns
    -------
    inertial.simulator.SimulatedRecording
        With the true attitude of the IMU at 10 Hz.

    Raises
    ------
    ValueError
        Unknown name, or figures out of range.
    """
    if scenario not in PARKED_SCENARIOS:
        raise ValueError(f"unknown scenario {scenario!r}: choose from {', '.join(PARKED_SCENARIOS)}")
    if not abs(latitude) <= 0.5 * math.pi:
        raise ValueError(f"latitude = {latitude} rad: must be from -pi/2 to pi/2")
    grade, scheme = PARKED_SCENARIOS[scenario].grade, PARKED_SCENARIOS[scenario].scheme
    noise_rng, sway_rng = map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2))
    motion = _parked_motion(scheme, duration, heading, _Sway(duration, disturbance, sway_rng))
    trajectory = Trajectory(scenario, duration, motion, float(normal_gravity(latitude)), latitude)
    sampled = sample_trajectory(trajectory, imu_rate=imu_rate)
    imu = sampled.imu
    curved = ImuSeries(imu.stamp_ns, imu.gyro_b + grade.gyro_curvature * imu.gyro_b ** 2,
                       imu.accel_b + grade.accel_curvature * imu.accel_b ** 2)
    measured = apply_imu_errors(curved, grade.errors, noise_rng)
    at = slice(None, None, max(1, round(_TRUTH_PERIOD * imu_rate)))
    truth = AttitudeSeries(sampled.truth.stamp_ns[at], sampled.truth.q_nb_wxyz[at])
    return SimulatedRecording(
        scenario, measured.imu, truth=truth, gyro_bias_b=measured.gyro_bias_b,
        accel_bias_b=measured.accel_bias_b, velocity_n=sampled.velocity_n[at],
        position_n=sampled.position_n[at], gravity=sampled.gravity)


def _parked_motion(scheme, duration, heading, sway):
    """Return the motion of an IMU that turns by a rate of its own in a vehicle that sways and may drive."""
    turn_rate = _turn_rate(scheme, duration)
    drive = _drive(scheme, duration, heading)
    axes_n = dcm_nb_from_euler(ROLL, PITCH, heading)

    def motion(time):
        body = drive(time)
        angle, rate, acceleration = sway(time)
        # Any small path will do, as long as velocity and acceleration are its derivatives.
        vehicle = Motion(body.roll + angle[..., 0], body.pitch + angle[..., 1], body.heading + angle[..., 2],
                         body.roll_rate + rate[..., 0], body.pitch_rate + rate[..., 1],
                         body.heading_rate + rate[..., 2],
                         body.velocity_n + np.cross(rate, _LEVER) @ axes_n.T,
                         body.acceleration_n + np.cross(acceleration, _LEVER) @ axes_n.T)
        turned = dcm_nb_from_euler(0.0, 0.0, turn_rate.integral(time))
        rate_b = np.einsum("...ji,...j->...i", turned, vehicle.rate_b)
        rate_b[..., 2] += turn_rate(time)
        return TableMotion(vehicle.dcm_nb @ turned, rate_b, vehicle.velocity_n, vehicle.acceleration_n)
    return motion


def _turn_rate(scheme, duration):
    """Return the IMU's rate of turn in the vehicle as a profile of time."""
    knots, rates = [START], [0.0]
    if scheme == "two_position":
        start = 0.5 * (duration - _HALF_TURN)
        rate = math.pi / (_HALF_TURN - _RAMP)
        knots = [start, start + _RAMP, start + _HALF_TURN - _RAMP, start + _HALF_TURN]
        rates = [0.0, rate, rate, 0.0]
    elif scheme == "rotating":
        turn = 2 * math.pi / _ROTATION_RATE
        for leg in range(math.ceil(duration / turn)):
            rate = _ROTATION_RATE * (-1) ** leg
            knots += [knots[-1] + _RAMP, knots[-1] + turn, knots[-1] + turn + _RAMP]
            rates += [rate, rate, 0.0]
    else:
        knots, rates = knots + [START + 1.0], [0.0, 0.0]
    return Profile(knots, rates)


def _drive(scheme, duration, heading):
    """Return the motion of a vehicle without sway, which drives off in the middle or not at all."""
    start = 0.5 * (duration - MOVE)
    moved = _DRIVE_ANGLES if scheme == "moved" else np.zeros(3)
    roll, pitch, course = (Profile([start, start + MOVE], [first, first + change])
                           for first, change in zip((ROLL, PITCH, heading), moved, strict=True))
    top = _DRIVE_SPEED if scheme == "moved" else 0.0
    speed = Profile([start, start + 0.5 * MOVE, start + MOVE], [0.0, top, 0.0])

    def motion(time):
        psi, psi_rate, v, v_rate = course(time), course(time, 1), speed(time), speed(time, 1)
        ahead = np.stack([np.cos(psi), np.sin(psi), np.zeros_like(psi)], axis=-1)
        right = np.stack([-np.sin(psi), np.cos(psi), np.zeros_like(psi)], axis=-1)
        return Motion(roll(time), pitch(time), psi, roll(time, 1), pitch(time, 1), psi_rate,
                      v[..., None] * ahead, v_rate[..., None] * ahead + (v * psi_rate)[..., None] * right)
    return motion


class _Sway:
    """Small angles of a sprung body in wind, with people in it, as a function of time.

    Parameters
    ----------
    duration : float, s
    strength : float
    rng : numpy.random.Generator
    """

    def __init__(self, duration, strength, rng):
        frequency = rng.uniform(*_WIND_BAND, _WIND_LINES)
        ratio = frequency / _RESONANCE
        response = 1.0 / np.hypot(1.0 - ratio ** 2, 2.0 * _DAMPING * ratio)
        shares = response / np.linalg.norm(response)
        phase = rng.uniform(0.0, 2.0 * math.pi, (_WIND_LINES, 3))
        amplitude = strength * math.sqrt(2.0) * shares[:, None] * _WIND_STD
        self._omega = 2.0 * math.pi * frequency
        self._sines, self._cosines = amplitude * np.cos(phase), amplitude * np.sin(phase)
        # The first walk after the end makes sure that there is one.
        gaps = _WALK + rng.exponential(_PAUSE, 1 + math.ceil(duration / _WALK))
        starts = np.cumsum(gaps)
        starts = starts[:1 + np.searchsorted(starts, duration)]
        knots = np.stack([starts, starts + _WALK], axis=-1).ravel()
        leans = np.concatenate([np.zeros((1, 3)), strength * _LEAN_STD * rng.standard_normal((len(starts), 3))])
        self._leans = [Profile(knots, np.stack([lean[:-1], lean[1:]], axis=-1).ravel()) for lean in leans.T]
        self._walks = Profile((starts[:, None] + [0.0, _RAMP, _WALK - _RAMP, _WALK]).ravel(),
                              np.tile([0.0, 1.0, 1.0, 0.0], len(starts)))
        self._step = strength * _STEP_AMPLITUDE

    def __call__(self, time):
        """Return the angles about x, y, z, their first and their second derivatives, (..., 3)."""
        phase = time[..., None] * self._omega
        sine, cosine, omega = np.sin(phase), np.cos(phase), self._omega
        wind = (sine @ self._sines + cosine @ self._cosines,
                (omega * cosine) @ self._sines - (omega * sine) @ self._cosines,
                -(omega ** 2 * sine) @ self._sines - (omega ** 2 * cosine) @ self._cosines)
        steps = self._footsteps(time)
        return [wind[k] + steps[k][..., None] * self._step
                + np.stack([lean(time, k) for lean in self._leans], axis=-1) for k in range(3)]

    def _footsteps(self, time):
        omega = 2.0 * math.pi * _STEP_RATE
        sine, cosine = np.sin(omega * time), np.cos(omega * time)
        on, on_rate, on_acceleration = (self._walks(time, k) for k in range(3))
        return (on * sine, on_rate * sine + omega * on * cosine,
                on_acceleration * sine + 2.0 * omega * on_rate * cosine - omega ** 2 * on * sine)
