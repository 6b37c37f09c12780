"""Parameters of the navigation filters, in SI; sensors and place are those of the attitude estimator."""

import math
from dataclasses import dataclass, fields

import numpy as np

from attitude_estimator.params import AttitudeParams, LevelParams
from inertial.parameters import parameter

STEADY_GAIN_LIMIT = math.sqrt(6.0) - math.sqrt(2.0)
"""Largest natural frequency times interval at which paper 001's gain, applied once a fix, is stable."""


@dataclass(frozen=True)
class NavigationParams(LevelParams):
    """What the navigation filters assume of sensors, motion and place.

    Raises
    ------
    ValueError
        From the constructor, naming the parameter, its value and its range; also where the steady gain would be
        unstable.
    """

    estimator: str = parameter(
        "eskf15", "", "eskf15: one error-state filter of 15 states; cascade: paper 001's attitude and "
        "gyro-bias filter, then a position and velocity filter", choices=("eskf15", "cascade"), runtime=False)
    gain: str = parameter(
        "riccati", "", "cascade: riccati computes the gain of each fix, steady is paper 001's (fixes only, at "
        "fix_interval)", choices=("riccati", "steady"), runtime=False)

    fix_std: float = parameter(
        2.5, "m", "error of a fix, each axis, where its message does not say", 1e-4, 1e4)
    fix_slow_share: float = parameter(
        0.5, "", "share of a fix's variance that changes slowly, as multipath does, and so does not average out; 0: "
        "white noise", 0.0, 1.0)
    fix_slow_time: float = parameter(60.0, "s", "how long that part lasts", 1.0, 1e5)
    velocity_std: float = parameter(
        0.2, "m/s", "error of a velocity, each axis, where its message does not say", 1e-4, 1e3)
    inclinometer_std: float = parameter(0.02, "rad", "error of an inclinometer, each axis", 1e-6, 1.0)
    heading_std: float = parameter(
        0.05, "rad", "error of a heading where its message does not say", 1e-6, 3.0)
    antenna_position: tuple = parameter(
        (0.0, 0.0, 0.0), "m", "of the GNSS antenna seen from the IMU, in the IMU's axes (FLU)", -1000.0, 1000.0)
    heading_start_std: float = parameter(
        0.17, "rad", "spread of the heading at which the start hands over to the filter of small errors",
        0.01, 0.5)
    innovation_gate: float = parameter(
        25.0, "", "squared normalised innovation above which a measurement is refused (3 more for each "
        "further component)", 4.0, 1e4)
    recovery_time: float = parameter(
        2.0, "s", "after so long a refusal a sensor is believed again and the filter is opened to it", 0.0, 600.0)
    measurement_buffer: float = parameter(
        0.5, "s", "how late a measurement may arrive and still count at its stamp", 0.0, 2.0, runtime=False)
    cascade_bias_std: float = parameter(
        0.3, "m/s^2", "cascade: spread of the acceleration error of each navigation axis", 1e-6, 10.0)
    cascade_bias_time: float = parameter(
        10.0, "s", "cascade: its correlation time", 0.1, 1e5)
    fix_interval: float = parameter(
        1.0, "s", "cascade with the steady gain: interval of the fixes", 1e-3, 100.0)

    def __post_init__(self):
        super().__post_init__()
        frequency = self.axis_frequency()
        if self.gain == "steady" and frequency * self.fix_interval > STEADY_GAIN_LIMIT:
            raise ValueError(
                f"gain = steady: natural frequency {frequency:.4g} rad/s times fix_interval {self.fix_interval:g} s "
                f"is {frequency * self.fix_interval:.4g}, above {STEADY_GAIN_LIMIT:.4f}: the gain is unstable; use "
                "gain = riccati")

    def axis_frequency(self):
        """Paper 001's ``(Q/Rc)^(1/4)``, rad/s, of accel_noise_density and fix_std at fix_interval."""
        return axis_frequency(self.accel_noise_density, self.fix_std, self.fix_interval)

    def level_params(self):
        """Return the AttitudeParams of the estimator that levels the start."""
        names = [field.name for field in fields(LevelParams) if field.name != "estimator"]
        return AttitudeParams(**{name: getattr(self, name) for name in names})

    def flat(self, names):
        """Values of the named parameters as float64, the derived ones included; the antenna's place in FRD."""
        x, y, z = self.antenna_position
        derived = {"cascade": self.estimator == "cascade", "steady": self.gain == "steady",
                   "local_gravity": self.local_gravity(), "axis_frequency": self.axis_frequency(),
                   "antenna_x": x, "antenna_y": -y, "antenna_z": -z}
        return np.array([derived[n] if n in derived else getattr(self, n) for n in names], dtype=float)


def axis_frequency(accel_noise_density, fix_std, interval):
    """Return paper 001's natural frequency ``(Q/Rc)^(1/4)``, rad/s (eq 9), with ``Rc = R_d T``."""
    return math.sqrt(accel_noise_density / (fix_std * math.sqrt(interval)))
