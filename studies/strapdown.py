"""The strapdown navigator against closed forms and exact motions over the turning Earth.

``study_strapdown`` writes docs/results/strapdown.md and its plots; every figure in it is computed here, noise-free.
"The paper" is the source of :mod:`inertial.strapdown`, whose figures 2.3 and 2.4 are the algorithm.
"""

import argparse
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from inertial.earth import (
    SEMI_MAJOR_AXIS,
    STANDARD_GRAVITY,
    earth_rate_n,
    normal_gravity,
    radii_of_curvature,
    transport_rate_n,
)
from inertial.imu_errors import Calibration
from inertial.rotation import (
    dcm_nb_from_euler,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_from_dcm,
    quaternion_log,
    quaternion_multiply,
)
from inertial.strapdown import (
    SCHEMES,
    NavigationState,
    Strapdown,
    StrapdownParams,
    VerticalChannelError,
    combine_increments,
)
from inertial.trajectory import Motion
from studies.timing import times_in_turn

DEG = np.pi / 180
MICRO_G = 1e-6 * STANDARD_GRAVITY
LATITUDE = 45 * DEG
HOUR = 3600.0

CONING_ANGLE = 0.1 * DEG
ORDER_ANGLE = 0.02 * DEG
CONING_MAJOR = 0.01  # s
CONING_TIME = 20.0  # s
SCULLING_FORCE = 10.0  # m/s^2: with 0.1 deg in phase the true mean force is 890 ug
SCULLING_TIME = 20.0  # s
CONING_LIMITS = {"2": 0.25, "2+previous": 0.02, "3": 2e-3, "4": 1e-5}  # deg/h
ORDERS, ORDER_TOLERANCE = {"2": 5, "2+previous": 7, "3": 7, "4": 9}, 0.2
SCULLING_LIMITS = {"2": 5.0, "2+previous": 0.5, "3": 0.05, "4": 1e-3}  # ug

STATIC_LIMIT = 1e-3  # m
SCHULER_AMPLITUDE, SCHULER_AMPLITUDE_PART = 636.4, 0.01  # m
SCHULER_PERIOD, SCHULER_PERIOD_PART = 84.4 * 60, 0.005  # s
MANOEUVRE_LIMIT = 5e-3  # m
VIBRATION_LIMIT = 0.2  # m
VIBRATION = 12.0  # Hz
STEP_LIMIT = 2.0  # us

# Four Gauss-Legendre nodes integrate a 12 Hz vibration over 2.5 ms to rounding.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_BLOCK = 20_000


# --- exact motions over the ellipsoid -----------------------------------------------------------------


@dataclass(frozen=True)
class Waves:
    """A quantity of time: ``start + slope t`` plus sine waves given as (amplitude, rad/s, phase)."""

    start: float = 0.0
    slope: float = 0.0
    waves: tuple = ()

    def __call__(self, t, derivative=0):
        """Return the value or a derivative at times (...)."""
        straight = (self.start + self.slope * t, np.full_like(t, self.slope), np.zeros_like(t))[derivative]
        return straight + sum(amplitude * rate**derivative * np.sin(rate * t + phase + derivative * np.pi / 2)
                              for amplitude, rate, phase in self.waves)

    def plus(self, *waves):
        """Return the same with more waves."""
        return replace(self, waves=self.waves + waves)


@dataclass(frozen=True)
class EarthMotion:
    """A motion over the ellipsoid: geodetic position and Euler angles as functions of time."""

    latitude: Waves
    longitude: Waves
    height: Waves
    roll: Waves = Waves()
    pitch: Waves = Waves()
    heading: Waves = Waves()

    def state(self, t):
        """Return the exact :class:`inertial.strapdown.NavigationState` at times (...)."""
        latitude, longitude, height = (quantity(t) for quantity in (self.latitude, self.longitude, self.height))
        q_nb_wxyz = quaternion_from_dcm(dcm_nb_from_euler(self.roll(t), self.pitch(t), self.heading(t)))
        return NavigationState(latitude, longitude, height, self._velocity_n(t)[0], q_nb_wxyz)

    def sensed(self, t):
        """Return what perfect sensors read, ``(gyro_b, accel_b)``, (..., 3)."""
        latitude, height = self.latitude(t), self.height(t)
        velocity_n, acceleration_n = self._velocity_n(t)
        motion = Motion(*(angle(t, k) for k in range(2) for angle in (self.roll, self.pitch, self.heading)),
                        velocity_n, acceleration_n)
        earth_n = earth_rate_n(latitude)
        frame_n = earth_n + transport_rate_n(latitude, height, velocity_n)
        force_n = acceleration_n + np.cross(earth_n + frame_n, velocity_n)
        force_n[..., 2] -= normal_gravity(latitude, height)
        dcm_nb = motion.dcm_nb
        return (motion.rate_b + np.einsum("...ji,...j->...i", dcm_nb, frame_n),
                np.einsum("...ji,...j->...i", dcm_nb, force_n))

    def samples(self, duration, interval):
        """Return means over sample intervals, (N, 3) each: rad/s and m/s^2."""
        count = round(duration / interval)
        blocks = []
        for first in range(0, count, _BLOCK):
            starts = interval * np.arange(first, min(first + _BLOCK, count))
            at = starts[:, None] + 0.5 * interval * (1 + _NODES)
            blocks.append([np.einsum("k,nki->ni", 0.5 * _WEIGHTS, values) for values in self.sensed(at)])
        return [np.concatenate(column) for column in zip(*blocks, strict=True)]

    def _velocity_n(self, t):
        """Return velocity_n and its derivative, (..., 3)."""
        latitude, height = self.latitude(t), self.height(t)
        rate, longitude_rate, climb = (quantity(t, 1) for quantity in (self.latitude, self.longitude, self.height))
        meridian, transverse = radii_of_curvature(latitude)
        sine, cosine = np.sin(latitude), np.cos(latitude)
        # d(transverse)/d(latitude) is this times transverse; three times as much for the meridian.
        growth = (1 - meridian / transverse) * np.tan(latitude) * rate
        north_radius, parallel = meridian + height, (transverse + height) * cosine
        velocity_n = np.stack([north_radius * rate, parallel * longitude_rate, -climb], axis=-1)
        parallel_rate = (transverse * growth + climb) * cosine - (transverse + height) * sine * rate
        acceleration_n = np.stack([
            north_radius * self.latitude(t, 2) + (3 * meridian * growth + climb) * rate,
            parallel * self.longitude(t, 2) + parallel_rate * longitude_rate, -self.height(t, 2)], axis=-1)
        return velocity_n, acceleration_n


def period(seconds):
    """Return the angular frequency, rad/s."""
    return 2 * np.pi / seconds


AT_REST = EarthMotion(Waves(LATITUDE), Waves(0.5), Waves(100.0), Waves(6 * DEG), Waves(-4 * DEG), Waves(30 * DEG))
LEVEL_AT_REST = EarthMotion(Waves(LATITUDE), Waves(0.5), Waves(100.0))
MANOEUVRE = EarthMotion(
    Waves(LATITUDE, 0.0, ((4000 / 6.38e6, period(240), 0.0),)),
    Waves(0.5, 0.0, ((6000 / 4.5e6, period(400), 1.0),)),
    Waves(1000.0, 0.0, ((200.0, period(180), 0.5),)),
    Waves(0.0, 0.0, ((30 * DEG, period(25), 0.0),)),
    Waves(2 * DEG, 0.0, ((10 * DEG, period(17), 0.3),)),
    Waves(1.0, 2 * DEG, ((20 * DEG, period(31), 0.0),)))


def vibrating(motion):
    """Return the motion with 12 Hz of 0.1 deg coning and 5 m/s^2 in phase with the roll."""
    rate = 2 * np.pi * VIBRATION
    shake = 5.0 / rate**2
    return replace(
        motion, roll=motion.roll.plus((CONING_ANGLE, rate, 0.0)),
        pitch=motion.pitch.plus((CONING_ANGLE, rate, np.pi / 2)),
        latitude=motion.latitude.plus((shake / 6.38e6, rate, 0.0)),
        height=motion.height.plus((shake, rate, 0.0)))


def navigate(motion, duration, scheme, sample_interval, *, aided=True, accel_error=(0.0, 0.0, 0.0), every=None,
             **settings):
    """Run the navigator from the exact start of a motion through its exact samples.

    Returns
    -------
    time : (M,), s
    state, truth : NavigationState
    """
    params = StrapdownParams(scheme=scheme, sample_interval=sample_interval, **settings)
    gyro_b, accel_b = motion.samples(duration, sample_interval)
    steps = len(gyro_b) // SCHEMES[scheme].samples
    time = params.major_interval * np.arange(1, steps + 1)
    every = every or max(1, round(1.0 / params.major_interval))
    navigator = Strapdown(params, motion.state(np.zeros(())))
    state = navigator.run(gyro_b, accel_b + accel_error, motion.height(time) if aided else None, every)
    return time[every - 1::every], state, motion.state(time[every - 1::every])


def position_error_n(state, truth):
    """Return the position error north, east, down, (..., 3), m."""
    meridian, transverse = radii_of_curvature(truth.latitude)
    return np.stack([(state.latitude - truth.latitude) * (meridian + truth.height),
                     (state.longitude - truth.longitude) * (transverse + truth.height) * np.cos(truth.latitude),
                     truth.height - state.height], axis=-1)


def attitude_error_n(state, truth):
    """Return the small rotation that takes the true attitude to the navigator's, (..., 3), rad, NED."""
    return quaternion_log(quaternion_multiply(state.q_nb_wxyz, quaternion_conjugate(truth.q_nb_wxyz)))


# --- coning and sculling ------------------------------------------------------------------------------


def coning_drift(scheme, frequency, angle=CONING_ANGLE, duration=CONING_TIME):
    """Return the attitude drift about the cone's axis, deg/h, of increments exact in closed form."""
    rate, (dtheta_b, t) = 2 * np.pi * frequency, _coning_increments(scheme, frequency, angle, duration)
    phi, _ = combine_increments(dtheta_b[1:], np.zeros_like(dtheta_b[1:]), scheme, [*dtheta_b[0], 0, 0, 0])
    start, end = (_on_cone(angle, rate * at) for at in (0.0, t[-1]))
    error = quaternion_log(quaternion_multiply(_product(start, phi), quaternion_conjugate(end)))
    return abs(error[2]) / duration * HOUR / DEG


def _coning_increments(scheme, frequency, angle, duration):
    """Return increments, the first of them before time zero, and the times of their ends."""
    rate = 2 * np.pi * frequency
    interval = CONING_MAJOR / SCHEMES[scheme].samples
    t = interval * np.arange(-1, round(duration / interval) + 1)
    integral = np.stack([np.sin(angle) * np.cos(rate * t), np.sin(angle) * np.sin(rate * t),
                         -2 * rate * np.sin(angle / 2)**2 * t], axis=-1)
    return np.diff(integral, axis=0), t[1:]


def _on_cone(angle, phase):
    return np.array([np.cos(angle / 2), np.sin(angle / 2) * np.cos(phase), np.sin(angle / 2) * np.sin(phase), 0.0])


def _product(q, rotation_vectors):
    for step in quaternion_exp(rotation_vectors):
        q = quaternion_multiply(q, step)
    return q


def coning_order(scheme):
    """Return the order of the coning drift in frequency, from 10 to 20 Hz, where the angle's square rules."""
    low, high = (coning_drift(scheme, frequency, ORDER_ANGLE) for frequency in (10.0, 20.0))
    return np.log2(high / low)


def sculling(scheme, frequency=20.0):
    """Return the error of the mean force and the true mean force, ug.

    Roll ``a sin(W t)`` with the force ``F sin(W t)`` along the body's y axis: the mean force down is
    ``F J1(a)``, in which the terms beyond ``a/2 - a^3/16`` vanish.
    """
    rate, interval = 2 * np.pi * frequency, CONING_MAJOR / SCHEMES[scheme].samples
    t = interval * np.arange(-1, round(SCULLING_TIME / interval) + 1)
    dtheta_b, dvel_b = (np.zeros((len(t) - 1, 3)) for _ in range(2))
    dtheta_b[:, 0] = CONING_ANGLE * np.diff(np.sin(rate * t))
    dvel_b[:, 1] = -SCULLING_FORCE / rate * np.diff(np.cos(rate * t))
    phi, gained_b = combine_increments(dtheta_b[1:], dvel_b[1:], scheme, [*dtheta_b[0], *dvel_b[0]])
    roll = np.concatenate([[0.0], np.cumsum(phi[:-1, 0])])
    mean = np.sum(np.sin(roll) * gained_b[:, 1] + np.cos(roll) * gained_b[:, 2]) / SCULLING_TIME
    true = SCULLING_FORCE * (CONING_ANGLE / 2 - CONING_ANGLE**3 / 16)
    return abs(mean - true) / MICRO_G, true / MICRO_G
