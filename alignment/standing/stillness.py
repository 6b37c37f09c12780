"""Whether a vehicle stands, and whether its sensors are as good as the parameters say: by their readings alone."""

import math

import numpy as np

from alignment.standing import _kernels as kernels
from inertial.earth import EARTH_RATE

STILL_TIME = 1.0
"""Seconds that a vehicle must stand before the coarse alignment begins; the force is a mean of as long."""
SWAY_ANGLE = 5e-3
"""Angle, rad, within which a vehicle at rest keeps its attitude, whoever steps in."""
REST_BLOCK = 10.0
"""Seconds over which a mean rate tells a turn."""
LEVEL_TIME = 5.0
"""Seconds that the level is a mean of where the latitude is not known: the Earth turns on meanwhile."""
_LARGEST_FORCE_ERROR = 0.05  # of gravity: more is motion, or wrong units
_ANOTHER_SCALE = 0.02  # of gravity, by which the mean force of a vehicle at rest may differ from it
_CLEARLY = 5.0  # standard deviations of a bias
_NOISIER = 3.0  # times the density that was told: nobody knows his noise that well
_DEG_PER_HOUR = math.radians(1 / 3600)


class Stillness:
    """What the sensors of a vehicle show of its motion and of themselves, step by step.

    Parameters
    ----------
    params : alignment.standing.params.StandingParams

    Attributes
    ----------
    scale : float
        Force over gravity, of the last second.
    sway_var : float, (m/s)^2
        Square of the velocity that the forces of a second make, beside what the Earth's turn does.
    """

    def __init__(self, params):
        self._params = params
        self._rate = np.zeros(3)
        self._mean_rate, self._rate_time = np.zeros(3), 0.0
        self.begin_anew()

    def begin_anew(self):
        """Forget what belongs to one coarse alignment."""
        self.scale, self.sway_var, self._force = 1.0, 0.0, np.zeros(3)

    def looks_still(self, step, gyro_bias_b):
        """Whether the rate of the last second, without a known bias, and the force are those of a vehicle at rest."""
        dt, params = step[kernels.STEP_DT], self._params
        rate = step[kernels.STEP_DTHETA:kernels.STEP_DVEL] / dt
        force = np.linalg.norm(step[kernels.STEP_DVEL:kernels.STEP_MEAN_DVEL]) / dt
        self.scale += (force / params.local_gravity - self.scale) * min(dt, 1.0)
        self._rate += (rate - gyro_bias_b - self._rate) * min(dt / kernels.RATE_TIME, 1.0)
        turns = np.linalg.norm(self._rate) > params.largest_rate
        self._rate_time = 0.0 if turns else self._rate_time + dt
        self._mean_rate += (rate - self._mean_rate) * min(dt / min(max(self._rate_time, dt), REST_BLOCK), 1.0)
        return not (turns and not params.zero_velocity_while_turning) and abs(self.scale - 1) < _LARGEST_FORCE_ERROR

    def accelerates(self, step, sums, bias_known):
        """Whether the force of the last second, in axes that do not turn, differs from that of all the time.

        Parameters
        ----------
        step : (STEP_SIZE,) float64
        sums : (O_SIZE,) float64
            Of the coarse alignment so far.
        bias_known : bool
            Whether the gyros' biases are off the sums.
        """
        params = self._params
        time, dt = sums[kernels.O_TIME], step[kernels.STEP_DT]
        force = sums[:kernels.O_TIME].reshape(3, 3) @ step[kernels.STEP_DVEL:kernels.STEP_MEAN_DVEL] / dt
        mean = sums[kernels.O_ALPHA:kernels.O_BETA] / (min(time, LEVEL_TIME) if params.no_latitude else time)
        self._force += (force - self._force) * (min(dt / STILL_TIME, 1.0) if self._force.any() else 1.0)
        # The Earth turns, and so do axes carried by gyros with biases.
        rate = EARTH_RATE + (0.0 if bias_known else 3 * params.gyro_bias_spread) + 3 * params.gyro_noise_density
        allowed = params.largest_velocity / STILL_TIME + params.local_gravity * rate * time
        apart = np.linalg.norm(self._force - mean)
        # What the force of a second has made of the velocity, without the Earth's turn.
        turned = 0.5 * params.local_gravity * EARTH_RATE * time
        sway_var = STILL_TIME ** 2 * max(apart ** 2 - turned ** 2, 0.0)
        self.sway_var += (sway_var - self.sway_var) * min(dt / time, 1.0)
        return apart > allowed

    def scale_is_wrong(self, standing):
        """Whether the force is not gravity, more closely where a filter has found the vehicle to be ``standing``."""
        params = self._params
        allowed = _ANOTHER_SCALE + 3 * params.accel_bias_spread / params.local_gravity if standing \
            else _LARGEST_FORCE_ERROR
        return abs(self.scale - 1) > allowed

    def explain_rate(self):
        """Return why a steady rate is none of a vehicle at rest with the gyros that were told, or an empty string."""
        params, rate = self._params, float(np.linalg.norm(self._mean_rate))
        allowed = EARTH_RATE + _CLEARLY * params.gyro_bias_spread + SWAY_ANGLE / REST_BLOCK
        if self._rate_time < REST_BLOCK or rate < allowed:
            return ""
        bias = params.gyro_bias_std / _DEG_PER_HOUR
        return (f"the gyros read {rate / _DEG_PER_HOUR:.3g} deg/h all the time, the Earth's rate is 15 deg/h and "
                f"gyro_bias_std {bias:.3g} deg/h: that is too small, or the vehicle turns")


def explain_noise(noise_density, params):
    """Return by how much the samples are noisier than the parameters say, or an empty string.

    Parameters
    ----------
    noise_density : (6,) float64
        That the samples show, of gyros and accelerometers, rad/s and m/s^2 per root hertz.
    params : alignment.standing.params.StandingParams
    """
    told = []
    for sensor, name, shown in (("gyro", "gyro_noise_density", noise_density[:3]),
                                ("accelerometer", "accel_noise_density", noise_density[3:])):
        ratio = float(np.median(shown)) / getattr(params, name)
        if ratio > _NOISIER:
            told.append(f"{sensor} noise is {ratio:.3g} times what {name} says")
    return " and ".join(told)
