"""Parameters of the alignment of a standing vehicle, in SI, with defaults of a tactical-grade sensor.

A field that :class:`alignment.params.AlignmentParams` has too is the same one.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from alignment.params import AlignmentParams
from alignment.standing import _kernels as kernels
from inertial.earth import EARTH_RATE, SEMI_MAJOR_AXIS, STANDARD_GRAVITY, normal_gravity
from inertial.parameters import check_parameters, parameter

MODELS = {"riekf6": kernels.RIEKF6, "riekf12": kernels.RIEKF12, "mekf": kernels.MEKF, "ekf5": kernels.EKF5,
          "ekf10": kernels.EKF10, "ukf10": kernels.UKF10, "ipekf": kernels.IPEKF}
STANDING_METHODS = ("oba_riekf", "ipekf", "ekf5", "ekf10", "ukf10", "mekf", "riekf6")
VARIANTS = {"paper_literal": kernels.PAPER_LITERAL, "closed_loop": kernels.CLOSED_LOOP,
            "residual": kernels.RESIDUAL}
JACOBIANS = ("mended", "paper")
# Near a pole the Earth rate has no horizontal part to find north by.
SMALLEST_COS_LATITUDE = 1e-2
_SLOW_BRAKING = 0.05  # m/s^2, gentler than vehicles come to rest
_DEG = math.pi / 180
_DEG_PER_HOUR = _DEG / 3600
_TURNTABLE = {field.name: field for field in dataclasses.fields(AlignmentParams)}


def _shared(name):
    """Return a field that means what the turntable's of that name does."""
    field = _TURNTABLE[name]
    return dataclasses.field(default=field.default, metadata=field.metadata)


@dataclass(frozen=True)
class StandingParams:
    """Everything that the alignment of a standing vehicle needs to know."""

    method: str = parameter("oba_riekf", "", "How the heading is found: the default, or the filter of that name "
                            "behind the same coarse alignment.", choices=STANDING_METHODS)
    latitude: float = _shared("latitude")
    latitude_std: float = _shared("latitude_std")
    height: float = parameter(0.0, "m", "Above the ellipsoid; matters to gravity only.", -1e3, 1e4)
    gravity: float = _shared("gravity")
    gyro_noise_density: float = _shared("gyro_noise_density")
    gyro_bias_std: float = parameter(
        1.0 * _DEG_PER_HOUR, "rad/s", "Spread of the gyros' turn-on bias; sets the heading's floor.", 0.0)
    gyro_bias_instability: float = _shared("gyro_bias_instability")
    accel_noise_density: float = _shared("accel_noise_density")
    accel_bias_std: float = _shared("accel_bias_std")
    accel_bias_instability: float = parameter(
        5e-4, "m/s^2", "Floor of the accelerometers' Allan deviation.", 0.0)
    bias_time: float = parameter(
        3600.0, "s", "Time beyond which the biases walk at random; before it their noise is 1/f.", 1.0)
    scale_std: float = _shared("scale_std")
    zero_velocity_std: float = parameter(
        5e-3, "m/s", "Spread of the velocity of a vehicle that stands: people, wind.", 1e-9)
    zero_velocity_period: float = parameter(
        0.1, "s", "Between zero-velocity updates; 0 for one at every sample.", 0.0, 10.0)
    zero_velocity_while_turning: bool = parameter(
        False, "", "Whether a vehicle that turns still counts as standing, as on a turntable.")
    largest_rate: float = _shared("largest_rate")
    largest_velocity: float = parameter(
        0.1, "m/s", "A vehicle that stands moves no faster than this, people in it included.", 1e-3)
    coarse_window: float = parameter(30.0, "s", "Length of the coarse alignment.", 5.0, 600.0)
    feedback_period: float = parameter(
        1.0, "s", "Between corrections of the strapdown by the error model; 0 for open loop.", 0.0)
    target_std: float = _shared("target_std")
    robust: bool = _shared("robust")
    adaptive: bool = parameter(
        True, "", "Whether the zero-velocity noise is raised to what the innovations show.")
    jacobian: str = parameter(
        "mended", "", "Jacobian of the error model: the paper's believes in a heading that cannot be seen.",
        choices=JACOBIANS)
    variant: str = parameter(
        "closed_loop", "", "Form of the IPEKF.", choices=tuple(VARIANTS))
    horizon: int = parameter(10, "", "Samples that the IPEKF looks ahead.", 1, 200)
    weight_ratio: float = parameter(
        1e-4, "", "Ry / Qm of the IPEKF; larger moves the model error more.", 1e-12, 1e12)
    gain_period: float = parameter(1.0, "s", "Between computations of the IPEKF's gain.", 0.0)

    def __post_init__(self):
        check_parameters(self)

    @property
    def local_gravity(self):
        """Magnitude of gravity, m/s^2."""
        if not math.isnan(self.gravity):
            return self.gravity
        if math.isnan(self.latitude):
            return STANDARD_GRAVITY
        return float(normal_gravity(self.latitude, self.height))

    @property
    def no_latitude(self):
        """Whether the latitude is not known, or too near a pole for a heading."""
        return not math.cos(self.latitude) >= SMALLEST_COS_LATITUDE

    @property
    def drowned(self):
        """Whether the Earth rate is less than a bias, and no turn that tells them apart keeps the velocity."""
        return self.gyro_bias_spread > EARTH_RATE and not self.zero_velocity_while_turning

    @property
    def north_rate(self):
        """Horizontal Earth rate, rad/s."""
        return EARTH_RATE * math.cos(self.latitude)

    @property
    def gyro_bias_spread(self):
        """Spread of the gyro bias in this run, rad/s."""
        return math.hypot(self.gyro_bias_std, self.gyro_bias_instability)

    @property
    def accel_bias_spread(self):
        """Spread of the accelerometer bias in this run, m/s^2."""
        return math.hypot(self.accel_bias_std, self.accel_bias_instability)

    def constants(self):
        """Return what the kernels read, by :data:`alignment.standing._kernels.CONSTANT_NAMES`."""
        values = {
            "earth_north": self.north_rate, "earth_down": -EARTH_RATE * math.sin(self.latitude),
            "gravity": self.local_gravity, "radius": SEMI_MAJOR_AXIS, "tan_latitude": math.tan(self.latitude),
            "gyro_var": self.gyro_noise_density ** 2, "accel_var": self.accel_noise_density ** 2,
            "gyro_flicker_var": self.gyro_bias_instability ** 2,
            "accel_flicker_var": self.accel_bias_instability ** 2,
            "scale_var": self.scale_std ** 2, "zero_velocity_var": self.zero_velocity_std ** 2,
            "largest_drift": _SLOW_BRAKING + 3 * self.accel_bias_spread,
            "turning_allowed": self.zero_velocity_while_turning, "mended": self.jacobian == "mended",
            "variant": VARIANTS[self.variant]}
        return np.array([float(values[name] if name in values else getattr(self, name))
                         for name in kernels.CONSTANT_NAMES])
