"""The estimator as a program sees it: samples in, attitude with its covariance out.

:class:`AttitudeEstimator` takes one sample at a time (the node) or a whole recording (the offline
tools and the studies); both run the same compiled kernels and give the same numbers. Altitudes
count at their stamps, also when they arrive late. Frames and units: :mod:`inertial`.
"""

from dataclasses import dataclass, make_dataclass
from typing import ClassVar

import numpy as np

from attitude_estimator import _kernels as kernels
from attitude_estimator.params import AttitudeParams

ACTION_USE, ACTION_SKIP, ACTION_RESET = (
    kernels.ACTION_USE, kernels.ACTION_SKIP, kernels.ACTION_RESET)

FaultCounts = make_dataclass("FaultCounts", [(name, int) for name in kernels.FAULTS])
FaultCounts.__doc__ = "How often each fault of the input was seen since the estimator was made."


class TimeJumpError(ValueError):
    """A sample is not later than the one before it."""


@dataclass(frozen=True)
class Estimates:
    """Estimates after one sample (leading dimensions dropped) or after each of N samples.

    Attributes
    ----------
    stamp_ns : (N,) int64
    valid : (N,) bool
        False while there is no attitude yet: only altitude, velocity and biases mean something.
    q_nb_wxyz : (N, 4)
        Attitude; its heading is the integrated gyro, east where the attitude was first known.
    tilt_covariance_n : (N, 2, 2), rad^2
        Of the small rotation about the north and east axes of the estimate's own NED frame.
    yaw_variance : (N,), rad^2
    down_b : (N, 3)
    down_norm : (N,)
        Length of the filter's down direction before it was normalised; what it is off one shows its
        constraint at work.
    vd, altitude, vd_variance, altitude_variance : (N,), m/s, m and their squares
    gyro_bias_b, accel_bias_b, gyro_bias_variance, accel_bias_variance : (N, 3), rad/s, m/s^2
    gyro_b, accel_b : (N, 3), rad/s and m/s^2, the sample with the bias removed
    """

    ROW_SIZE: ClassVar[int] = kernels.OUT_SIZE

    stamp_ns: np.ndarray
    rows: np.ndarray

    def __len__(self):
        return len(self.rows)

    def _columns(self, start, size):
        return self.rows[..., start:start + size]

    @property
    def valid(self):
        return self.rows[..., kernels.OUT_VALID] > 0.0

    @property
    def q_nb_wxyz(self):
        return self._columns(kernels.OUT_Q, 4)

    @property
    def tilt_covariance_n(self):
        nn, ne, ee = np.moveaxis(self._columns(kernels.OUT_TILT_COV, 3), -1, 0)
        return np.stack([np.stack([nn, ne], -1), np.stack([ne, ee], -1)], -2)

    @property
    def yaw_variance(self):
        return self.rows[..., kernels.OUT_YAW_VAR]

    @property
    def down_b(self):
        return self._columns(kernels.OUT_DOWN, 3)

    @property
    def down_norm(self):
        return self.rows[..., kernels.OUT_NORM]

    @property
    def vd(self):
        return self.rows[..., kernels.OUT_VD]

    @property
    def altitude(self):
        return self.rows[..., kernels.OUT_ALT]

    @property
    def vd_variance(self):
        return self.rows[..., kernels.OUT_VD_VAR]

    @property
    def altitude_variance(self):
        return self.rows[..., kernels.OUT_ALT_VAR]

    @property
    def gyro_bias_b(self):
        return self._columns(kernels.OUT_BG, 3)

    @property
    def accel_bias_b(self):
        return self._columns(kernels.OUT_BA, 3)

    @property
    def gyro_bias_variance(self):
        return self._columns(kernels.OUT_BG_VAR, 3)

    @property
    def accel_bias_variance(self):
        return self._columns(kernels.OUT_BA_VAR, 3)

    @property
    def gyro_b(self):
        return self._columns(kernels.OUT_GYRO, 3)

    @property
    def accel_b(self):
        return self._columns(kernels.OUT_ACCEL, 3)


class AttitudeEstimator:
    """Roll and pitch from one IMU and an altimeter, if there is one.

    Parameters
    ----------
    params : AttitudeParams
    """

    def __init__(self, params=None):
        self._memory = np.zeros(kernels.MEMORY_SIZE)
        self.params = AttitudeParams() if params is None else params
        self.reset()

    @property
    def _ints(self):
        return self._memory[kernels.M_INTS:kernels.M_ALTITUDES].view(np.int64)

    @property
    def params(self):
        """AttitudeParams in use; setting them keeps the state."""
        return self._params

    @params.setter
    def params(self, params):
        if params.estimator not in ("dcm_row", "dcm_row5"):
            raise ValueError(f"estimator = {params.estimator!r}: AttitudeEstimator is dcm_row or dcm_row5; "
                             "attitude_estimator.rivals.make_estimator makes the others")
        self._memory[kernels.M_PARAMETERS:kernels.M_OUT] = params.flat(kernels.PARAMETER_NAMES)
        self._params = params

    def reset(self):
        """Forget everything but the fault counters, and start blind."""
        kernels.reset(self._memory)

    def start_at(self, down_b, tilt_std):
        """Start anew from a known attitude instead of blind.

        Parameters
        ----------
        down_b : (3,)
            Down direction in body axes; its length does not matter.
        tilt_std : float, rad
            Of the angle between it and the true one, 0.0 to 0.1.

        Raises
        ------
        ValueError
        """
        down_b = np.asarray(down_b, float) / np.linalg.norm(down_b)
        if not (np.all(np.isfinite(down_b)) and 0.0 <= tilt_std <= 0.1):
            raise ValueError(f"down_b = {down_b}, tilt_std = {tilt_std} rad: must be a direction and "
                             "from 0 to 0.1 rad")
        self.reset()
        n = kernels.N if self._params.estimator == "dcm_row" else kernels.N5
        covariance = self._memory[kernels.P:kernels.P + n * n].reshape(n, n)
        covariance[:3, :3] = 0.5 * tilt_std**2 * (np.eye(3) - np.outer(down_b, down_b))
        self._memory[kernels.X:kernels.X + 3] = down_b
        kernels.declare_attitude(self._memory)

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take one IMU sample.

        Parameters
        ----------
        stamp_ns : int
            End of the interval over which the sample is the mean.
        gyro_b, accel_b : (3,) float64 arrays, rad/s and m/s^2, FRD
            A value that is not finite or out of range is counted and bridged or left out.

        Returns
        -------
        bool
            Whether :attr:`estimate` is new.

        Raises
        ------
        TimeJumpError
            When the stamp is not later than the one before.
        ValueError
            When a sample has not three values.
        """
        done = kernels.push_imu(self._memory, stamp_ns, gyro_b, accel_b)
        if done < kernels.STALE:
            refuse_sample(self._ints[kernels.I_LAST_STAMP], stamp_ns, gyro_b, accel_b)
        return done == kernels.FRESH

    def add_altitude(self, stamp_ns, altitude, variance=0.0):
        """Take one altitude (m, up) at its stamp; variance (m^2) counts when > 0.

        Returns
        -------
        bool
            Whether it counts; if not, :attr:`faults` says why.
        """
        return kernels.push_altitude(self._memory, stamp_ns, altitude, variance)

    @property
    def estimate(self):
        """Estimates after the last sample, as a copy."""
        row = self._memory[kernels.M_OUT:kernels.M_INTS].copy()
        return Estimates(self._ints[kernels.I_LAST_STAMP], row)

    @property
    def free_fall(self):
        """Whether the low-passed force is too small to show where down is."""
        return bool(self._memory[kernels.FREE_FALL])

    @property
    def waiting_for(self):
        """What an attitude is missing while there is none."""
        if self._ints[kernels.I_STORED] == 0:
            return "a first good IMU sample: rate and force finite, in range and not all zero"
        if self.free_fall:
            return "a force of the size of gravity"
        return "gravity or altitude to settle the direction of down"

    def warm_up(self):
        """Run each kernel of the streaming path once, so that it is compiled; then start anew."""
        for k in range(4):
            self.add_altitude(1 + k * 40_000_000, 0.0)
            self.add_imu(1 + k * 40_000_000, np.zeros(3), np.array([0.0, 0.0, -9.8]))
        self.reset()

    @property
    def faults(self):
        """FaultCounts so far."""
        return FaultCounts(*(int(n) for n in self._ints[kernels.I_COUNTS:kernels.I_STAMPS]))

    def run(self, imu, altitude=None, altitude_variance=None, *, actions=None):
        """Take a whole recording, or the next part of one, in recorded order.

        Parameters
        ----------
        imu : ImuSeries
        altitude : AltitudeSeries, optional
        actions : (N,) int, optional
            ``ACTION_USE``, ``ACTION_SKIP`` or ``ACTION_RESET`` (start anew with this sample).
        altitude_variance : (M,), m^2, optional

        Returns
        -------
        estimates : Estimates
            One for each sample that gave output.
        fresh : (N,) bool
            Which samples did.

        Raises
        ------
        TimeJumpError
            When a stamp that is to be used is not later than the one before; the samples before it count.
        """
        actions = np.zeros(len(imu), dtype=np.int64) if actions is None else np.asarray(actions)
        if altitude is None:
            stamps = arrival = np.zeros(0, dtype=np.int64)
            values = variances = np.zeros(0)
        else:
            stamps, values, arrival = altitude.stamp_ns, altitude.altitude, altitude.arrival
            variances = np.zeros(len(values)) if altitude_variance is None else altitude_variance
        rows = np.empty((len(imu), kernels.OUT_SIZE))
        fresh = np.zeros(len(imu), dtype=bool)
        taken = kernels.run(self._memory, imu.stamp_ns, imu.gyro_b, imu.accel_b, actions,
                            stamps, values, variances, arrival, rows, fresh)
        if taken < len(imu):
            refuse_sample(self._ints[kernels.I_LAST_STAMP], imu.stamp_ns[taken], imu.gyro_b[taken], imu.accel_b[taken])
        if fresh.any():
            self._memory[kernels.M_OUT:kernels.M_INTS] = rows[np.flatnonzero(fresh)[-1]]
        if fresh.all():
            return Estimates(imu.stamp_ns, rows), fresh
        return Estimates(imu.stamp_ns[fresh], rows[fresh]), fresh


def refuse_sample(last_ns, stamp_ns, gyro_b, accel_b):
    """Raise what is wrong with a sample that a kernel did not take."""
    if len(gyro_b) != 3 or len(accel_b) != 3:
        raise ValueError(f"gyro_b and accel_b must have 3 values, got {len(gyro_b)} and {len(accel_b)}")
    raise TimeJumpError(f"IMU stamp {stamp_ns} ns is not later than {last_ns} ns")
