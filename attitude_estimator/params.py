"""Parameters of the roll and pitch estimators, in SI, with one set of defaults for every vehicle."""

import math
from dataclasses import dataclass

import numpy as np

from inertial.earth import EARTH_RATE, STANDARD_GRAVITY, normal_gravity
from inertial.parameters import check_parameters, parameter

ESTIMATORS = ("dcm_row", "dcm_row5", "dcm_row5_gamma", "euler_ukf", "euler_ukf_first_order", "euler_ekf",
              "euler_ekf_first_order", "quaternion_ekf", "complementary", "complementary_literal",
              "accelerometer", "gyro", "gyro_euler")


@dataclass(frozen=True)
class LevelParams:
    """What the default estimator assumes of sensors, motion and place.

    Raises
    ------
    ValueError
        From the constructor, naming the parameter, its value and its range.
    """

    estimator: str = parameter(
        "dcm_row", "", "dcm_row: biases, altitude and gravity; dcm_row5: the paper's linear filter, "
        "altitude only and no biases; the others: what it is compared with (attitude_estimator/rivals.py)",
        choices=ESTIMATORS, runtime=False)
    gravity: float = parameter(
        math.nan, "m/s^2", "local gravity", 9.7, 9.9,
        nan_means="WGS84 normal gravity at the latitude, or 9.80665 without one")
    latitude: float = parameter(
        math.nan, "rad", "geodetic latitude; the vertical Earth rate is then removed from the gyro",
        -math.pi / 2, math.pi / 2, nan_means="no Earth-rate compensation")

    gyro_noise_density: float = parameter(
        0.0022, "rad/s/sqrt(Hz)", "white noise of each gyro axis", 0.0, 1.0)
    gyro_rate_error: float = parameter(
        0.003, "sqrt(s)", "gyro noise that grows with the rate: scale factor, misalignment", 0.0, 1.0)
    gyro_bias_std: float = parameter(
        0.025, "rad/s", "spread of the gyro bias at switch-on; set it to your sensor's", 0.0, 1.0)
    gyro_bias_walk: float = parameter(
        5e-5, "rad/s/sqrt(s)", "random walk of the gyro bias", 0.0, 0.1)
    accel_noise_density: float = parameter(
        0.01, "m/s^2/sqrt(Hz)", "white noise of each accelerometer axis", 0.0, 10.0)
    accel_force_error: float = parameter(
        0.0025, "sqrt(s)", "accelerometer noise that grows with the acceleration", 0.0, 1.0)
    accel_vibration_share: float = parameter(
        0.03, "", "share of the vibration's power, from sample to sample, that counts as accelerometer noise",
        0.0, 10.0)
    accel_bias_std: float = parameter(
        0.05, "m/s^2", "spread of the accelerometer bias", 0.0, 5.0)
    accel_bias_time: float = parameter(
        200.0, "s", "correlation time of the accelerometer bias", 1.0, 1e6)

    gravity_time: float = parameter(
        1.65, "s", "time constant of the low-pass that finds gravity; larger trusts the gyro longer",
        0.05, 60.0)
    gravity_floor_std: float = parameter(
        0.12, "m/s^2", "acceleration left in the low-pass in quiet motion", 1e-4, 10.0)
    gravity_residual_share: float = parameter(
        0.33, "", "share of the present residual that counts as acceleration", 0.0, 10.0)
    gravity_decay_time: float = parameter(
        2.0, "s", "how long a residual is remembered", 0.05, 60.0)
    gravity_correlation: float = parameter(
        1.8, "", "correlation time of the acceleration in the low-pass, in gravity_time; larger is more "
        "careful", 0.0, 100.0)
    gravity_lasting_time: float = parameter(
        5.0, "s", "how long a residual has to last to be told from the come and go of motion", 0.05, 100.0)
    gravity_lasting_share: float = parameter(
        0.7, "", "share of a residual that lasts, beyond what tilt may be off, that counts as acceleration",
        0.0, 10.0)
    gravity_lasting_share_alone: float = parameter(
        0.1, "", "the same without an altimeter, where gravity alone would show a tilt that is off", 0.0, 10.0)
    gravity_pull_time: float = parameter(
        60.0, "s", "without an altimeter: how long an acceleration is reckoned with that may pull the attitude along",
        1.0, 1e4)
    gravity_start_std: float = parameter(
        4.7, "m/s^2", "distrust of gravity in the first second", 0.0, 50.0)
    gravity_bias_share: float = parameter(
        0.4, "", "share of its gain that the accelerometer bias takes from gravity", 0.0, 1.0)
    rest_gyro_std: float = parameter(
        0.005, "rad/s", "error of the zero-rate update at rest", 1e-6, 1.0)
    rest_accel_std: float = parameter(
        0.045, "m/s^2", "error of gravity at rest", 1e-5, 1.0)

    altitude_std: float = parameter(
        0.2, "m", "white noise of the altimeter; more is learnt from the data", 1e-3, 100.0)
    altitude_drift_density: float = parameter(
        0.036, "m/sqrt(s)", "random walk of the altimeter's zero", 0.0, 10.0)
    altitude_scale_error: float = parameter(
        0.026, "sqrt(s)", "altimeter noise that grows with vertical speed", 0.0, 1.0)
    altitude_delay: float = parameter(
        0.0, "s", "how much older an altitude is than its stamp", -1.0, 2.0)
    altitude_delay_std: float = parameter(
        0.2, "s", "spread of the delay: altitudes count less the faster they change", 0.0, 2.0)
    altitude_gate: float = parameter(
        6.25, "", "squared normalised innovation above which an altitude must be confirmed", 1.0, 100.0)
    altitude_step_gate: float = parameter(
        6.25, "", "squared mean innovation above which the height reference moved", 1.0, 100.0)

    gyro_range: float = parameter(
        100.0, "rad/s", "full scale of the gyro: beyond it a sample is refused, at it noise grows",
        0.1, 1e4)
    accel_range: float = parameter(
        1000.0, "m/s^2", "full scale of the accelerometer, as gyro_range", 5.0, 1e5)
    altitude_buffer: float = parameter(
        0.5, "s", "how late an altitude may arrive and still count at its stamp", 0.0, 5.0, runtime=False)
    gap_limit: float = parameter(
        1.0, "s", "longest gap in the IMU that is bridged; after a longer one the attitude starts anew",
        0.01, 10.0)

    def __post_init__(self):
        check_parameters(self)

    def local_gravity(self):
        """Gravity to use, m/s^2."""
        if not math.isnan(self.gravity):
            return self.gravity
        return STANDARD_GRAVITY if math.isnan(self.latitude) else normal_gravity(self.latitude)

    def earth_rate_down(self):
        """Downward component of the Earth's rotation, rad/s; 0 without a latitude."""
        return 0.0 if math.isnan(self.latitude) else -EARTH_RATE * math.sin(self.latitude)

    def flat(self, names):
        """Values of the named parameters as float64, the derived ones included."""
        derived = {"local_gravity": self.local_gravity(), "earth_rate_down": self.earth_rate_down(),
                   "model": float(ESTIMATORS.index(self.estimator))}
        return np.array([derived[n] if n in derived else getattr(self, n) for n in names], dtype=float)


@dataclass(frozen=True)
class AttitudeParams(LevelParams):
    """What any of the estimators assumes."""

    complementary_frequency: float = parameter(
        0.03, "rad/s", "complementary schemes: corner frequency, above which the gyro counts", 1e-4, 10.0)
    levelling_gate: float = parameter(
        0.5, "m/s^2", "accelerometer: how far the force's size may be off gravity", 0.0, 10.0)
    norm_gain: float = parameter(
        50.0, "1/s", "dcm_row5_gamma: the paper's k; must stay below the sample rate", 0.0, 1e4)
