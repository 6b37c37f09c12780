"""Parameters of an alignment on a turntable, in SI, with defaults of a tactical-grade sensor."""

import math
from dataclasses import dataclass

from inertial.earth import STANDARD_GRAVITY, normal_gravity
from inertial.parameters import check_parameters, parameter

METHODS = ("joint", "azimuth_1a", "azimuth_1b", "azimuth_2", "azimuth_3", "azimuth_4", "azimuth_5",
           "azimuth_6")
LEVELLINGS = ("joint", "levelling_1", "levelling_2", "levelling_3", "levelling_4", "levelling_5")
SEQUENCES = ("palindrome", "single_pass", "refined")
_DEG = math.pi / 180
_DEG_PER_HOUR = _DEG / 3600


@dataclass(frozen=True)
class NorthPriors:
    """What is known besides the readings, as standard deviations; larger ones give more cautious results."""

    scale_std: float = parameter(1e-3, "", "Gyro scale factor error.", 0.0, 1.0)
    skew_std: float = parameter(1e-3, "rad", "Each gyro's turn about the table's axis.", 0.0, 0.2)
    table_zero_std: float = parameter(
        1e-4, "rad", "Zero of the table's angle; a heading error of the same size.", 0.0, 0.2)
    latitude_std: float = parameter(1e-5, "rad", "Latitude.", 0.0, 0.2)

    def __post_init__(self):
        check_parameters(self)


@dataclass(frozen=True)
class AlignmentParams(NorthPriors):
    """Everything a turntable alignment needs to know, the priors among it."""

    method: str = parameter("joint", "", "How the heading is found.", choices=METHODS)
    levelling: str = parameter("joint", "", "How the level is found.", choices=LEVELLINGS)
    latitude: float = parameter(
        float("nan"), "rad", "Geodetic latitude.", -0.5 * math.pi, 0.5 * math.pi,
        nan_means="not known: no heading is given")
    gyro_noise_density: float = parameter(
        0.1 * _DEG / 60, "rad/s/sqrt(Hz)", "White noise of the gyros (angle random walk).", 1e-12)
    gyro_bias_instability: float = parameter(
        1.0 * _DEG_PER_HOUR, "rad/s", "Floor of the gyros' Allan deviation.", 0.0)
    accel_noise_density: float = parameter(
        5e-4, "m/s^2/sqrt(Hz)", "White noise of the accelerometers.", 1e-12)
    accel_bias_std: float = parameter(
        0.02, "m/s^2", "Spread of the accelerometers' biases; matters to the z axis.", 0.0)
    accel_scale_std: float = parameter(1e-3, "", "Accelerometer scale factor error.", 0.0, 1.0)
    gravity: float = parameter(
        float("nan"), "m/s^2", "Magnitude of gravity.", 1.0, 20.0, nan_means="WGS84 at the latitude")
    use_y_gyro: bool = parameter(True, "", "Whether the y gyro counts beside the x one.")
    estimate_drift: bool = parameter(False, "", "Whether a steady drift of the gyro bias is fitted too.")
    sequence: str = parameter("refined", "", "Order of the table angles.", choices=SEQUENCES)
    dwell_time: float = parameter(15.0, "s", "Used time at each angle.", 0.1)
    settle_time: float = parameter(1.0, "s", "Time dropped after the table has moved.", 0.0)
    coarse_time: float = parameter(
        120.0, "s", "Time at the four positions before the best two.", 1.0)
    target_std: float = parameter(0.1 * _DEG, "rad", "Heading accuracy asked for.", 1e-9)
    largest_rate: float = parameter(
        0.02, "rad/s", "A table that stands turns no faster than this, gyro bias included.", 1e-4)
    largest_angle_spread: float = parameter(
        1e-3, "rad", "Spread of the table angle within a dwell.", 0.0)
    position_tolerance: float = parameter(
        math.radians(0.5), "rad", "How near two table angles are the same position.", 1e-6, 0.5)
    still_threshold: float = parameter(
        5.0, "", "Deviations by which a part of a dwell may differ from the rest.", 2.0)
    joint_delay: float = parameter(
        0.0, "s", "How late the stamps of the joint are against those of the IMU.", -1.0, 1.0)
    joint_delay_std: float = parameter(
        2e-3, "s", "Spread of that delay; matters to a table that turns one way only.", 0.0, 1.0)
    robust: bool = parameter(True, "", "Whether single outlying samples are left out.")

    @property
    def local_gravity(self):
        """Magnitude of gravity, m/s^2."""
        if not math.isnan(self.gravity):
            return self.gravity
        return STANDARD_GRAVITY if math.isnan(self.latitude) else float(normal_gravity(self.latitude))
