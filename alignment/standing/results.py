"""The result of a standing alignment, of the coarse stage and of a filter."""

import math
from dataclasses import dataclass

import numpy as np

from alignment.standing import _kernels as kernels
from alignment.standing.bound import heading_floor, time_to_target
from alignment.standing.coarse import (
    UNKNOWN_HEADING_STD,
    align_by_gravity,
    bias_sensitivity,
    level_by_force,
    limit_heading,
)
from alignment.standing.filters import WITHOUT_BIASES
from inertial.rotation import dcm_from_quaternion, euler_from_dcm


@dataclass(frozen=True)
class StandingResult:
    """An alignment.

    Attributes
    ----------
    stamp_ns : int
    q_nb_wxyz : (4,)
    covariance : (3, 3), rad^2
        Of the small rotation in navigation axes, with what the filter does not model.
    velocity_n : (3,), m/s
        Which should be zero.
    gyro_bias_b, accel_bias_b : (3,), rad/s and m/s^2
        Zero where the filter has none.
    gyro_bias_std, accel_bias_std : (3,)
    heading, heading_std, roll, pitch : float, rad
    floor : float, rad
        Smallest heading spread that the sensors allow so far.
    nis : float
        Normalised squared innovation per component, 1 when all is as modelled.
    cost : float
        J* of the IPEKF; NaN for others.
    time : float, s
        Since the alignment began.
    time_left : float, s
        Until the target may be reached; inf for never.
    """

    stamp_ns: int
    q_nb_wxyz: np.ndarray
    covariance: np.ndarray
    velocity_n: np.ndarray
    gyro_bias_b: np.ndarray
    accel_bias_b: np.ndarray
    gyro_bias_std: np.ndarray
    accel_bias_std: np.ndarray
    heading: float
    heading_std: float
    roll: float
    pitch: float
    floor: float
    nis: float
    cost: float
    time: float
    time_left: float


def coarse_result(stamp_ns, sums, sway_std, params):
    """Return the result of the coarse alignment so far; the level alone where the latitude is of no use.

    Parameters
    ----------
    stamp_ns : int
    sums : (O_SIZE,) float64
        Of :func:`alignment.standing._kernels.run_coarse`.
    sway_std : float, m/s
    params : alignment.standing.params.StandingParams
    """
    found = level_by_force(sums, params) if params.no_latitude else align_by_gravity(sums, params, sway_std)
    row = np.full(kernels.OUT_SIZE, np.nan)
    row[kernels.OUT_V:kernels.OUT_BG_VAR] = 0.0
    row[:4] = found.q_nb_wxyz
    east = found.time * dcm_from_quaternion(found.q_nb_wxyz)[1]
    return _result(stamp_ns, row, found.covariance, east, found.time, params)


def fine_result(stamp_ns, fine, params):
    """Return the result of a filter: of :class:`alignment.standing.fine.Remembered` or ``Followed``."""
    found = fine.filter
    covariance = found.attitude_covariance()
    covariance[2, 2] += fine.doubt_var
    if found.name in WITHOUT_BIASES:
        force, rate = bias_sensitivity(params)
        covariance = covariance + params.accel_bias_spread ** 2 * force @ force.T \
            + params.gyro_bias_spread ** 2 * rate @ rate.T
    return _result(stamp_ns, found.row(), covariance, found.q[kernels.Q_EAST:kernels.Q_COST], found.time, params)


def _result(stamp_ns, row, covariance, east, time, params):
    covariance = limit_heading(covariance)
    floor = UNKNOWN_HEADING_STD if params.no_latitude else heading_floor(east, time, params)
    roll, pitch, heading = (float(angle) for angle in euler_from_dcm(dcm_from_quaternion(row[:4])))
    bias_std = np.sqrt(row[kernels.OUT_BG_VAR:kernels.OUT_NIS])
    return StandingResult(
        stamp_ns, row[:4], covariance, row[kernels.OUT_V:kernels.OUT_BG], row[kernels.OUT_BG:kernels.OUT_BA],
        row[kernels.OUT_BA:kernels.OUT_BG_VAR], bias_std[:3], bias_std[3:], heading, math.sqrt(covariance[2, 2]),
        roll, pitch, floor, float(row[kernels.OUT_NIS]), float(row[kernels.OUT_COST]), time,
        math.inf if params.no_latitude else time_to_target(floor, time, params))
