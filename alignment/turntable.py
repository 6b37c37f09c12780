"""A turntable on the turning Earth and the sensors on it: exact readings, and readings with errors.

Frames: N is NED; T is the table at table angle zero, ``dcm_nt`` of its roll, pitch and heading
(:func:`inertial.rotation.dcm_nb_from_euler`); B is the sensor body, turned by the table angle ``tau`` about
the table's z (down): ``v_b = Rz(tau)^T v_t``. With a lever arm the body's origin lies on its x axis. Angles
in rad, rates in rad/s, forces in m/s^2.

Source: Mohammadkarimi, Nourani, Alizadeh Roknabadi, "The derivation of modern inertial navigation methods at
stationary state" (2023), "the paper" in this package; equations 12 to 18 and 35 to 39, derived again.
"""

from dataclasses import dataclass

import numpy as np

from alignment.bounds import flicker_covariance
from inertial.earth import EARTH_RATE, STANDARD_GRAVITY, earth_rate_n
from inertial.parameters import check_parameters, parameter
from inertial.rotation import dcm_nb_from_euler, down_from_roll_pitch

_ZEROS = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Turntable:
    """Where the table stands, and its own imperfections."""

    roll: float = parameter(0.0, "rad", "Roll of the table.")
    pitch: float = parameter(0.0, "rad", "Pitch of the table.")
    heading: float = parameter(0.0, "rad", "Heading of the table's x axis at table angle zero.")
    latitude: float = parameter(0.0, "rad", "Geodetic latitude.", -0.5 * np.pi, 0.5 * np.pi)
    gravity: float = parameter(STANDARD_GRAVITY, "m/s^2", "Magnitude of gravity.", 1.0, 20.0)
    lever_arm: float = parameter(0.0, "m", "From the table's axis to the sensors, along body x.")
    encoder_zero: float = parameter(0.0, "rad", "True table angle less its reading.")
    encoder_eccentricity: float = parameter(
        0.0, "rad", "Once-a-turn error of the encoder: its amplitude, zero at reading zero.")
    wobble: float = parameter(
        0.0, "rad", "Tilt of the axis that goes twice around the table in each turn: its size.")

    def __post_init__(self):
        check_parameters(self)


@dataclass(frozen=True)
class TriadErrors:
    """Fixed errors and noise of three gyros or three accelerometers; the defaults are perfect.

    Units are those of the readings (rad/s or m/s^2), per root hertz for the noise density.
    """

    bias: tuple = parameter(_ZEROS, "", "Constant error.")
    drift: tuple = parameter(_ZEROS, "", "Growth of the error per second.")
    scale: tuple = parameter(_ZEROS, "", "Scale factor error of each axis.")
    misalignment: float = parameter(0.0, "rad", "What each axis takes from both others.")
    noise_density: float = parameter(0.0, "", "White noise per root hertz.", 0.0)
    bias_instability: float = parameter(0.0, "", "Floor of the Allan deviation (1/f noise).", 0.0)

    def __post_init__(self):
        check_parameters(self)

    @property
    def matrix(self):
        """What multiplies the true value, (3, 3)."""
        return np.diag(np.add(1.0, self.scale)) + self.misalignment * (1 - np.eye(3))


@dataclass(frozen=True)
class TableReadings:
    """Mean readings over the intervals of a schedule.

    Attributes
    ----------
    gyro_b : (..., K, 3) float64, rad/s
    accel_b : (..., K, 3) float64, m/s^2
    """

    gyro_b: np.ndarray
    accel_b: np.ndarray


def earth_direction_t(roll, pitch, heading, latitude):
    """Return the Earth rate in table axes in units of the Earth rate, (..., 3): the paper's X, Y, Z."""
    dcm_nt = dcm_nb_from_euler(roll, pitch, heading)
    unit_n = earth_rate_n(latitude) / EARTH_RATE
    return np.einsum("...ji,...j->...i", dcm_nt, unit_n)


def exact_readings(table, angle, rate=0.0, acceleration=0.0):
    """Return what perfect sensors read.

    Parameters
    ----------
    table : Turntable
    angle : (...) float64, rad
        Reading of the table's encoder.
    rate, acceleration : (...) float64, rad/s and rad/s^2
        Of the table.

    Returns
    -------
    TableReadings
    """
    angle, rate, acceleration = np.broadcast_arrays(angle, rate, acceleration)
    true_angle = angle + table.encoder_zero + table.encoder_eccentricity * np.sin(angle)
    tilt_t, tilt_rate_t = _wobble(table, true_angle, rate)
    earth_t = EARTH_RATE * earth_direction_t(table.roll, table.pitch, table.heading, table.latitude)
    gravity_t = table.gravity * down_from_roll_pitch(table.roll, table.pitch)

    earth_b = _to_body(true_angle, earth_t - np.cross(tilt_t, earth_t))
    gravity_b = _to_body(true_angle, gravity_t - np.cross(tilt_t, gravity_t))
    zero = np.zeros_like(rate)
    spin_b, spin_up_b = np.stack([zero, zero, rate], -1), np.stack([zero, zero, acceleration], -1)
    arm_b = np.array([table.lever_arm, 0.0, 0.0])
    velocity_b = np.cross(spin_b, arm_b)
    accel_b = (np.cross(spin_b, velocity_b) + np.cross(spin_up_b, arm_b)
               + 2 * np.cross(earth_b, velocity_b) - gravity_b)
    return TableReadings(earth_b + _to_body(true_angle, tilt_rate_t) + spin_b, accel_b)


def simulate_readings(table, schedule, gyro_errors, accel_errors, rng, trials=None):
    """Return mean readings of sensors with errors.

    Parameters
    ----------
    table : Turntable
    schedule : alignment.sequences.Schedule
    gyro_errors, accel_errors : TriadErrors
    rng : numpy.random.Generator
    trials : int, optional
        Number of independent repetitions, the leading dimension; none without it.

    Returns
    -------
    TableReadings

    Notes
    -----
    1/f noise is exact up to a constant, which is part of the bias. It needs a K x K factor, so that it
    suits dwells and not samples.
    """
    exact = exact_readings(table, schedule.angle, schedule.rate)
    shape = (len(schedule.angle), 3) if trials is None else (trials, len(schedule.angle), 3)
    return TableReadings(_measure(exact.gyro_b, gyro_errors, schedule, rng, shape),
                         _measure(exact.accel_b, accel_errors, schedule, rng, shape))


def _measure(truth_b, errors, schedule, rng, shape):
    reading = truth_b @ errors.matrix.T + errors.bias + np.outer(schedule.middle, errors.drift)
    noise = errors.noise_density / np.sqrt(schedule.duration)[:, None] * rng.standard_normal(shape)
    if errors.bias_instability > 0:
        factor = _contrast_factor(schedule, errors.bias_instability)
        noise += np.einsum("ij,...jk->...ik", factor, rng.standard_normal(shape))
    return reading + noise


def _contrast_factor(schedule, bias_instability):
    """Return a factor of the 1/f noise's covariance with its mean over the intervals taken out."""
    covariance = flicker_covariance(schedule, bias_instability)
    count = len(covariance)
    centre = np.eye(count) - 1.0 / count
    variances, vectors = np.linalg.eigh(centre @ covariance @ centre)
    return vectors * np.sqrt(np.maximum(variances, 0.0))


def _wobble(table, angle, rate):
    """Return the tilt of the axis as a small rotation in table axes, and its rate."""
    zero = np.zeros_like(angle)
    tilt_t = table.wobble * np.stack([np.cos(2 * angle), np.sin(2 * angle), zero], -1)
    slope_t = 2 * table.wobble * np.stack([-np.sin(2 * angle), np.cos(2 * angle), zero], -1)
    return tilt_t, slope_t * rate[..., None]


def _to_body(angle, vector_t):
    """Return vectors in body axes, ``Rz(angle)^T v_t``."""
    x, y, z = np.moveaxis(np.broadcast_to(vector_t, (*np.shape(angle), 3)), -1, 0)
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, z], -1)
