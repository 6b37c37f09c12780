"""The filters of the standing alignment over a recording, from any first attitude.

Two families share one covariance arithmetic. riekf6, riekf12 and mekf carry an attitude, a velocity (and biases)
and correct them at every zero velocity. With ``dcm^ = exp(phi x) dcm``, the invariant error of the velocity
``rho = v^ - exp(phi x) v``, the biases' errors in navigation axes ``beta = dcm^ (b^ - b)`` and rates of Earth and
transport ``w``::

    phi' = -w x phi - beta_g        rho' = g x phi - (2 wie + wen) x rho - beta_a         (riekf)
                                    dv'  = -(dcm f) x phi - (2 wie + wen) x dv - beta_a    (mekf)

so at rest the invariant filter's gain does not depend on how wrong the heading is, and what cannot be observed, tilt
beside an accelerometer's bias, does not seem to be because the heading swings (A. Barrau, S. Bonnabel, The invariant
extended Kalman filter as a stable observer, IEEE Trans. Automatic Control 62(4), 2017). ekf5, ekf10, ukf10 and
ipekf estimate the error of a strapdown, the computed frame n', by the nonlinear model of N. Ghahramani and
H. Majed Alhassan's paper on the IPEKF (appendix A, mended), ``C_n^n' = (I - phi_h x) Rz(phi_D)``; its measurement
is the strapdown's velocity, and every ``feedback_period`` the strapdown is corrected.
"""

import math
from dataclasses import dataclass

import numpy as np

from alignment.standing import _kernels as kernels
from alignment.standing.params import MODELS
from inertial.earth import EARTH_RATE
from inertial.rotation import dcm_from_quaternion, euler_from_dcm

GROUP_FILTERS = ("riekf6", "riekf12", "mekf")
WITHOUT_BIASES = ("riekf6", "ekf5", "ipekf")
VELOCITY_STD = 0.1
"""Spread of the first velocity, m/s, of every filter (the study's P0)."""
TILT_STD = math.radians(1.0)
"""Spread of the first tilt in the study's P0, rad."""
GRAVITY_STD = 5e-4
"""Spread of gravity about the WGS84 formula, m/s^2; no accelerometer bias tells it from one along the vertical."""


@dataclass(frozen=True)
class FilterHistory:
    """What a filter found, row by row.

    Attributes
    ----------
    stamp_ns : (K,) int64
    rows : (K, OUT_SIZE) float64
        By the layout of the kernels; read it through the properties.
    """

    stamp_ns: np.ndarray
    rows: np.ndarray

    def __len__(self):
        return len(self.rows)

    def _columns(self, start, size=3):
        return self.rows[..., start:start + size]

    @property
    def q_nb_wxyz(self):
        """Attitude, (K, 4)."""
        return self._columns(kernels.OUT_Q, 4)

    @property
    def covariance(self):
        """Covariance of the small rotation in navigation axes as the filter has it, (K, 3, 3), rad^2."""
        nn, ne, nd, ee, ed, dd = np.moveaxis(self._columns(kernels.OUT_COV, 6), -1, 0)
        return np.stack([np.stack([nn, ne, nd], -1), np.stack([ne, ee, ed], -1), np.stack([nd, ed, dd], -1)], -2)

    @property
    def heading(self):
        """Heading, (K,), rad."""
        return euler_from_dcm(dcm_from_quaternion(self.q_nb_wxyz))[2]

    @property
    def heading_std(self):
        """Spread of the heading as the filter has it, (K,), rad."""
        return np.sqrt(self.rows[..., kernels.OUT_COV + 5])

    @property
    def velocity_n(self):
        """Velocity, which should be zero, (K, 3), m/s; of ekf5 and its kin without the vertical."""
        return self._columns(kernels.OUT_V)

    @property
    def gyro_bias_b(self):
        """Gyro bias, (K, 3), rad/s; zero where the filter has none."""
        return self._columns(kernels.OUT_BG)

    @property
    def accel_bias_b(self):
        """Accelerometer bias, (K, 3), m/s^2; zero where the filter has none."""
        return self._columns(kernels.OUT_BA)

    @property
    def gyro_bias_std(self):
        """Spread of the gyro bias, (K, 3), rad/s; NaN where the filter has none."""
        return np.sqrt(self._columns(kernels.OUT_BG_VAR))

    @property
    def accel_bias_std(self):
        """Spread of the accelerometer bias, (K, 3), m/s^2; NaN where the filter has none."""
        return np.sqrt(self._columns(kernels.OUT_BA_VAR))

    @property
    def nis(self):
        """Normalised squared mean innovation per component, running mean, (K,); 1 when all is as modelled."""
        return self.rows[..., kernels.OUT_NIS]

    @property
    def cost(self):
        """Cost J* of the predictive algorithm for Qm = 1, (K,); NaN for other filters."""
        return self.rows[..., kernels.OUT_COST]


class Filter:
    """One of the filters with its state.

    Parameters
    ----------
    name : str
        A key of :data:`alignment.standing.params.MODELS`.
    params : StandingParams
    q_nb_wxyz : (4,)
        First attitude.
    covariance : (3, 3), rad^2
        Of the small rotation in navigation axes.
    bias : (6,), optional
        First gyro and accelerometer bias, for filters that have them.
    bias_covariance : (6, 6), optional
        By default the priors.
    """

    def __init__(self, name, params, q_nb_wxyz, covariance, bias=None, bias_covariance=None):
        self.name, self.model = name, MODELS[name]
        self.in_steps = name in GROUP_FILTERS
        self.constants = params.constants()
        self.R = dcm_from_quaternion(np.asarray(q_nb_wxyz, dtype=float))
        self.m = np.zeros(kernels.M_SIZE)
        self.P = np.zeros((12, 12))
        self.q = np.zeros(kernels.Q_SIZE)
        self.q[kernels.Q_SCALE] = self.q[kernels.Q_NIS] = 1.0
        if bias_covariance is None:
            bias_covariance = bias_priors(params, self.R)
        if bias is not None and name != "riekf6":
            self.m[kernels.M_BG:kernels.M_X] = bias
        if self.in_steps:
            self.P[:3, :3] = covariance
            self.P[3:6, 3:6] = VELOCITY_STD ** 2 * np.eye(3)
            self.P[6:, 6:] = turned_biases(bias_covariance, self.R)
        else:
            self.P[:2, :2] = VELOCITY_STD ** 2 * np.eye(2)
            self.P[2:5, 2:5] = covariance
            self.P[5:10, 5:10] = bias_covariance[:5, :5]
        p = params.horizon if name == "ipekf" else 1
        self.ipa = (np.zeros((p, 2, 5)), np.zeros((5, 2 * p)), np.zeros((2 * p, 2 * p)), np.zeros((5, 7)),
                    np.zeros(7))

    def run_steps(self, steps, rows):
        """Use steps of :func:`alignment.standing._kernels.reduce_samples`; return how many, and the event."""
        return kernels.run_group(self.model, self.constants, self.R, self.m, self.P, self.q, steps, rows)

    def snapshot(self):
        """Return a copy of the state, for :meth:`restore`."""
        return tuple(array.copy() for array in (self.R, self.m, self.P, self.q))

    def restore(self, snapshot):
        """Go back to a state."""
        for array, kept in zip((self.R, self.m, self.P, self.q), snapshot, strict=True):
            array[:] = kept

    def bias_covariance(self):
        """Return the covariance (6, 6) of gyro and accelerometer bias in body axes, of riekf12 and mekf."""
        return turned_biases(self.P[6:, 6:], self.R.T)

    def run_samples(self, dt, gyro_b, accel_b, standing, every, rows):
        """Use samples; return how many, and the event that stopped it."""
        return kernels.run_error_model(self.model, self.constants, self.R, self.m, self.P, self.q, self.ipa, dt,
                                       gyro_b, accel_b, standing, every, rows)

    @property
    def time(self):
        """Time that it has run for, s."""
        return float(self.q[kernels.Q_TIME])

    @property
    def moving(self):
        """Whether zero velocities are suspended."""
        return self.q[kernels.Q_MOVING] != 0.0

    def attitude_covariance(self):
        """Return the covariance (3, 3) of the small rotation in navigation axes, rad^2."""
        start = 0 if self.in_steps else 2
        return self.P[start:start + 3, start:start + 3].copy()

    def correlate_biases(self, sensitivity):
        """Tell an error model that the first attitude is wrong by what the biases make of it.

        Parameters
        ----------
        sensitivity : tuple of two (3, 3)
            From :func:`alignment.standing.coarse.bias_sensitivity`. The model's phi is the other way round.
        """
        force, rate = sensitivity
        self.P[2:5, 5:8] = -rate @ self.R @ self.P[5:8, 5:8]
        self.P[2:5, 8:10] = -force @ self.R[:, :2] @ self.P[8:10, 8:10]
        self.P[5:10, 2:5] = self.P[2:5, 5:10].T

    def row(self):
        """Return the present row of output, (OUT_SIZE,)."""
        row = np.empty(kernels.OUT_SIZE)
        fill = kernels.group_row if self.in_steps else kernels.error_model_row
        fill(self.model, self.R, self.m, self.P, self.q, row)
        return row


def turned_biases(covariance, dcm):
    """Return the covariance (6, 6) of the biases in other axes."""
    T = np.kron(np.eye(2), dcm)
    return T @ covariance @ T.T


def bias_priors(params, dcm_nb):
    """Return the prior covariance (6, 6) of gyro and accelerometer bias.

    A wrong latitude looks like a gyro bias, wrong gravity like an accelerometer's.
    """
    latitude = 0.0 if math.isnan(params.latitude) else params.latitude
    by_latitude = -EARTH_RATE * params.latitude_std * (
        math.sin(latitude) * dcm_nb[0] + math.cos(latitude) * dcm_nb[2])
    P = np.zeros((6, 6))
    P[:3, :3] = params.gyro_bias_spread ** 2 * np.eye(3) + np.outer(by_latitude, by_latitude)
    P[3:, 3:] = params.accel_bias_spread ** 2 * np.eye(3) + GRAVITY_STD ** 2 * np.outer(dcm_nb[2], dcm_nb[2])
    return P


def run_filter(name, imu, q0_wxyz, P0, params, period=1.0):
    """Run one filter over a recording of a standing vehicle.

    Parameters
    ----------
    name : str
        riekf6, riekf12, mekf, ekf5, ekf10, ukf10 or ipekf.
    imu : inertial.recording.ImuSeries
        Each sample the mean over the interval that ends at its stamp; the first interval is as long as the second.
    q0_wxyz : (4,)
        Attitude at the start of the first interval, wrong by as much as is to be tried.
    P0 : (3, 3), rad^2
        Its covariance, of the small rotation in navigation axes; with velocity of :data:`VELOCITY_STD` and biases
        by the priors.
    params : StandingParams
        ``zero_velocity_std`` is sigma_R at every ``zero_velocity_period`` (0: at every sample, as the paper has
        it); noise densities make Q; ``robust`` and ``adaptive`` off leave the plain filter; ``variant``,
        ``horizon``, ``weight_ratio``, ``gain_period``, ``jacobian`` and ``feedback_period`` are of the error model.
    period : float, s
        About the time between rows of the history.

    Returns
    -------
    FilterHistory
    """
    dt = sample_intervals(imu.stamp_ns)
    state = Filter(name, params, q0_wxyz, P0)
    every = max(1, round(period / np.median(dt)))
    if not state.in_steps:
        return _run_on_samples(state, imu, dt, every)
    steps, ends = reduce(imu, dt, params.zero_velocity_period)
    rows = np.empty((len(steps), kernels.OUT_SIZE))
    used = 0
    while used < len(steps):
        used += state.run_steps(steps[used:], rows[used:])[0]
    stride = max(1, round(period / np.median(steps[:, kernels.STEP_DT])))
    return FilterHistory(imu.stamp_ns[ends[stride - 1::stride]], rows[stride - 1::stride])


def _run_on_samples(state, imu, dt, every):
    rows = np.empty((len(dt) // every, kernels.OUT_SIZE))
    for k in range(len(rows)):
        part, used = slice(k * every, (k + 1) * every), 0
        while used < every:
            used += state.run_samples(dt[part][used:], imu.gyro_b[part][used:], imu.accel_b[part][used:], True, 1,
                                      rows[:0])[0]
        rows[k] = state.row()
    return FilterHistory(imu.stamp_ns[every - 1::every][:len(rows)], rows)


def reduce(imu, dt, period):
    """Return the steps (K, STEP_SIZE) of a recording and the index of the sample that ends each, (K,)."""
    steps, ends = np.empty((len(dt), kernels.STEP_SIZE)), np.empty(len(dt), dtype=np.int64)
    count = kernels.reduce_samples(np.zeros(kernels.A_SIZE), dt, np.ascontiguousarray(imu.gyro_b, dtype=float),
                                   np.ascontiguousarray(imu.accel_b, dtype=float), period, steps, ends)
    return steps[:count], ends[:count]


def sample_intervals(stamp_ns):
    """Return the intervals that end at the stamps, (N,), s; the first is as long as the second."""
    dt = np.diff(stamp_ns) * 1e-9
    return np.concatenate([dt[:1], dt])


def heading_covariance(heading_std, tilt_std=TILT_STD):
    """Return the diagonal P0 of a tilt and a heading known to so many rad."""
    return np.diag([tilt_std ** 2, tilt_std ** 2, heading_std ** 2])
