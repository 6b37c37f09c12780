"""Motions known exactly at every instant: attitude, rate, velocity, acceleration.

A motion is a table of manoeuvres. Each row says how long it takes and which speed, pitch, turn rate
... it ends with; between rows every column follows a :class:`Profile`, whose derivatives and
integral are polynomials. Three laws turn columns into a motion:

- :func:`flight`: nose along the velocity, banked for a coordinated level turn, loops and rolls;
- :func:`multirotor`: specific force along the body's up axis, so tilt and acceleration are one;
- :func:`car`: nose along the road, which is a function of distance, on suspension springs.

Units are SI and rad, axes are NED and FRD (:mod:`inertial`); the Earth is flat. Nothing here knows
sensors: :mod:`inertial.simulator` samples a motion.
"""

from dataclasses import dataclass

import numpy as np

from inertial.rotation import dcm_nb_from_euler

# The step u^4 (35 - 84 u + 70 u^2 - 20 u^3) has three vanishing derivatives at both ends.
_STEP = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
_STEP_INTEGRAL = _STEP.integ()


class Profile:
    """A quantity that moves smoothly from value to value and rests at each, before and after.

    Three times continuously differentiable.

    Parameters
    ----------
    knots : (K,) increasing
        Times or distances, K >= 2.
    values : (K,)
    """

    def __init__(self, knots, values):
        self._knots = np.asarray(knots, dtype=float)
        self._values = np.asarray(values, dtype=float)
        self._lengths = np.diff(self._knots)
        means = 0.5 * (self._values[1:] + self._values[:-1])
        self._integrals = np.concatenate([[0.0], np.cumsum(means * self._lengths)])

    def __call__(self, at, derivative=0):
        """Return the value, or its ``derivative``-th derivative, at times or distances (...)."""
        k, u = self._locate(at)
        step = self._values[k + 1] - self._values[k]
        if derivative == 0:
            return self._values[k] + step * _STEP(u)
        return step / self._lengths[k] ** derivative * _STEP.deriv(derivative)(u)

    def integral(self, at):
        """Return the integral from the first knot to ``at`` (...)."""
        k, u = self._locate(at)
        start, length = self._values[k], self._lengths[k]
        step = self._values[k + 1] - start
        inside = self._integrals[k] + length * (start * u + step * _STEP_INTEGRAL(u))
        outside = at - np.clip(at, self._knots[0], self._knots[-1])
        return inside + outside * (start + step * _STEP(u))

    def _locate(self, at):
        k = np.searchsorted(self._knots, at, side="right") - 1
        k = np.clip(k, 0, len(self._lengths) - 1)
        return k, np.clip((at - self._knots[k]) / self._lengths[k], 0.0, 1.0)


@dataclass(frozen=True)
class Motion:
    """The state of motion at times (...).

    Attributes
    ----------
    roll, pitch, heading : (...), rad
        Continuous, so a loop takes pitch through 360 deg.
    roll_rate, pitch_rate, heading_rate : (...), rad/s
        Their derivatives.
    velocity_n : (..., 3), m/s
    acceleration_n : (..., 3), m/s^2
    """

    roll: np.ndarray
    pitch: np.ndarray
    heading: np.ndarray
    roll_rate: np.ndarray
    pitch_rate: np.ndarray
    heading_rate: np.ndarray
    velocity_n: np.ndarray
    acceleration_n: np.ndarray

    @property
    def dcm_nb(self):
        """Attitude, (..., 3, 3)."""
        return dcm_nb_from_euler(self.roll, self.pitch, self.heading)

    @property
    def rate_b(self):
        """Angular rate of the body against the navigation frame, (..., 3), rad/s."""
        sr, cr = np.sin(self.roll), np.cos(self.roll)
        down_turn = self.heading_rate * np.cos(self.pitch)
        return np.stack([self.roll_rate - self.heading_rate * np.sin(self.pitch),
                         self.pitch_rate * cr + down_turn * sr,
                         down_turn * cr - self.pitch_rate * sr], axis=-1)


def flight(speed, pitch, turn_rate, roll, gravity, speed_lost_inverted=0.0):
    """Return the motion of a fixed-wing aircraft as a function of time.

    The bank angle atan(speed * turn_rate / gravity), which coordinates a level turn, is added to
    ``roll``.

    Parameters
    ----------
    speed, pitch, turn_rate, roll : Profile of time
        m/s, rad, rad/s, rad.
    gravity : float, m/s^2
    speed_lost_inverted : float
        Share of the speed lost where pitch is 180 deg, half of it at +-90 deg.
    """
    def motion(t):
        theta, theta_rate = pitch(t), pitch(t, 1)
        psi, psi_rate = turn_rate.integral(t), turn_rate(t)
        kept = 1 - 0.5 * speed_lost_inverted * (1 - np.cos(theta))
        kept_rate = -0.5 * speed_lost_inverted * np.sin(theta) * theta_rate
        v = speed(t) * kept
        v_rate = speed(t, 1) * kept + speed(t) * kept_rate
        lateral = v * psi_rate / gravity
        lateral_rate = (v_rate * psi_rate + v * turn_rate(t, 1)) / gravity
        return Motion(roll(t) + np.arctan(lateral), theta, psi,
                      roll(t, 1) + lateral_rate / (1 + lateral ** 2), theta_rate, psi_rate,
                      *_along_nose(theta, psi, v, theta_rate, psi_rate, v_rate))
    return motion


def multirotor(north, east, up, turn_rate, gravity):
    """Return the motion of a multirotor without drag as a function of time.

    Parameters
    ----------
    north, east, up : Profile of time
        Velocities, m/s; the acceleration down stays below gravity.
    turn_rate : Profile of time, rad/s
    gravity : float, m/s^2
    """
    def motion(t):
        velocity_n, acceleration_n, jerk_n = (
            np.stack([north(t, k), east(t, k), -up(t, k)], axis=-1) for k in range(3))
        psi, psi_rate = turn_rate.integral(t), turn_rate(t)
        sine, cosine = np.sin(psi), np.cos(psi)
        # The thrust is -(forward, right, down) in level axes that turn with the heading.
        forward = -(cosine * acceleration_n[..., 0] + sine * acceleration_n[..., 1])
        right = -(cosine * acceleration_n[..., 1] - sine * acceleration_n[..., 0])
        down = gravity - acceleration_n[..., 2]
        forward_rate = psi_rate * right - (cosine * jerk_n[..., 0] + sine * jerk_n[..., 1])
        right_rate = -psi_rate * forward - (cosine * jerk_n[..., 1] - sine * jerk_n[..., 0])
        down_rate = -jerk_n[..., 2]
        level2 = forward ** 2 + down ** 2
        level = np.sqrt(level2)
        level_rate = (forward * forward_rate + down * down_rate) / level
        return Motion(np.arctan2(-right, level), np.arctan2(forward, down), psi,
                      (right * level_rate - level * right_rate) / (level2 + right ** 2),
                      (down * forward_rate - forward * down_rate) / level2, psi_rate,
                      velocity_n, acceleration_n)
    return motion


# A passenger car's body angles, rad per m/s^2: nose up accelerating, leaning out of the turn.
_SQUAT = np.radians(0.3)
_LEAN = np.radians(0.4)


def car(speed, curvature, slope):
    """Return the motion of a car as a function of time.

    Parameters
    ----------
    speed : Profile of time, m/s
    curvature : Profile of distance, 1/m, positive to the right
    slope : Profile of distance, rad, positive uphill
    """
    def motion(t):
        distance, v, v_rate = speed.integral(t), speed(t), speed(t, 1)
        gamma, gamma_rate = slope(distance), slope(distance, 1) * v
        bend = curvature(distance)
        psi, psi_rate = curvature.integral(distance), bend * v
        lateral_rate = curvature(distance, 1) * v ** 3 + 2 * bend * v * v_rate
        return Motion(-_LEAN * bend * v ** 2, gamma + _SQUAT * v_rate, psi,
                      -_LEAN * lateral_rate, gamma_rate + _SQUAT * speed(t, 2), psi_rate,
                      *_along_nose(gamma, psi, v, gamma_rate, psi_rate, v_rate))
    return motion


def _along_nose(pitch, heading, speed, pitch_rate, heading_rate, speed_rate):
    """Return velocity_n and acceleration_n of something that moves where pitch and heading point."""
    axes_n = dcm_nb_from_euler(0.0, pitch, heading)
    along_axes = np.stack([speed_rate, speed * heading_rate * np.cos(pitch), -speed * pitch_rate],
                          axis=-1)
    return (speed[..., None] * axes_n[..., 0],
            np.einsum("...ij,...j->...i", axes_n, along_axes))
