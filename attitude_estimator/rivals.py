"""The other ways to find roll and pitch, with the methods of the default estimator.

They are what the paper has besides its linear filter, and what it is compared with; docs/attitude.md has
their equations. None of them estimates a bias, and none can start without an attitude: each begins level
with the first force it gets. Two limits differ from :class:`~attitude_estimator.estimator.AttitudeEstimator`:
an altitude is used in order of arrival, with its age, and nothing is taken back for a late one; and a sample
with a value that is not finite or out of range is left out whole. Frames and units: :mod:`inertial`.

==========================  ========================================================================
``dcm_row5_gamma``          the paper's linear filter with its own hold of the norm, ``norm_gain`` gamma
``euler_ukf``               unscented filter of roll, pitch, velocity, altitude; Runge-Kutta steps
``euler_ukf_first_order``   the same with first-order steps
``euler_ekf``               extended Kalman filter of the same model; Runge-Kutta steps
``euler_ekf_first_order``   the same with first-order steps
``quaternion_ekf``          extended Kalman filter of quaternion, velocity and altitude
``complementary``           figure 1: PI turn towards the accelerometer's down direction
``complementary_literal``   equation 18 as it is printed
``accelerometer``           equations 10 and 11, held while the force is not of gravity's size
``gyro``                    equation 5: the gyro alone, quaternion
``gyro_euler``              equation 4: the gyro alone, Euler angles
==========================  ========================================================================

The Euler ones are singular at pitch +-90 deg: their output stays finite, but is worth nothing after it. A
filter that has lost itself starts anew (counted as ``restarted``). The last five have no covariance of their
own and tell a fixed tilt spread of 5 deg; the altitude they give is the last one received.
"""

import numpy as np

from attitude_estimator import _kernels as layout
from attitude_estimator import _rival_kernels as kernels
from attitude_estimator.estimator import AttitudeEstimator, Estimates, FaultCounts, refuse_sample

RIVALS = kernels.MODELS

_COLUMNS = np.concatenate([np.arange(start, start + size) for start, size in (
    (layout.OUT_Q, 4), (layout.OUT_TILT_COV, 3), (layout.OUT_YAW_VAR, 1), (layout.OUT_DOWN, 3),
    (layout.OUT_NORM, 1), (layout.OUT_VD, 1), (layout.OUT_ALT, 1), (layout.OUT_VD_VAR, 1),
    (layout.OUT_ALT_VAR, 1), (layout.OUT_GYRO, 3), (layout.OUT_ACCEL, 3))])


def make_estimator(params):
    """Return the estimator that ``params.estimator`` names, not yet started."""
    return RivalEstimator(params) if params.estimator in RIVALS else AttitudeEstimator(params)


class RivalEstimator:
    """One of :data:`RIVALS`; see the module.

    Parameters
    ----------
    params : AttitudeParams
        Their ``estimator`` is one of :data:`RIVALS`.
    """

    def __init__(self, params):
        self._memory = np.zeros(kernels.MEMORY_SIZE)
        self._ints = np.zeros(kernels.I_SIZE, dtype=np.int64)
        self._row = np.zeros(kernels.ROW_SIZE)
        self._valid = False
        self.params = params

    @property
    def params(self):
        """AttitudeParams in use; setting them keeps the state, unless it is another estimator's."""
        return self._params

    @params.setter
    def params(self, params):
        if params.estimator not in RIVALS:
            raise ValueError(f"estimator = {params.estimator}: must be one of {', '.join(RIVALS)}")
        self._memory[kernels.PARAMETERS:] = params.flat(kernels.PARAMETER_NAMES)
        self._params = params
        model = RIVALS.index(params.estimator)
        if model != self._ints[kernels.I_MODEL]:
            self._ints[kernels.I_MODEL] = model
            self.reset()

    def reset(self):
        """Forget everything but the fault counters."""
        kernels.reset(self._memory, self._ints)
        self._valid = False

    def start_at(self, down_b, tilt_std):
        """Start anew from a known attitude instead of from the first force.

        Parameters
        ----------
        down_b : (3,)
            Down direction in body axes; its length does not matter.
        tilt_std : float, rad
            Of the angle between it and the true one.

        Raises
        ------
        ValueError
        """
        down_b = np.asarray(down_b, float) / np.linalg.norm(down_b)
        if not (np.all(np.isfinite(down_b)) and 0.0 <= tilt_std <= np.pi):
            raise ValueError(f"down_b = {down_b}, tilt_std = {tilt_std} rad: must be a direction and 0 to pi")
        self.reset()
        kernels.start(self._memory, self._ints, tuple(down_b.tolist()), float(tilt_std) ** 2)

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take one IMU sample; as :meth:`AttitudeEstimator.add_imu`."""
        done = kernels.push_imu(self._memory, self._ints, stamp_ns, gyro_b, accel_b)
        if done < kernels.STALE:
            refuse_sample(self._ints[kernels.I_LAST_STAMP], stamp_ns, gyro_b, accel_b)
        if done == kernels.FRESH:
            self._valid = True
            kernels.write_row(self._memory, self._ints, self._row)
        return done == kernels.FRESH

    def add_altitude(self, stamp_ns, altitude, variance=0.0):
        """Take one altitude (m, up), with its age; variance (m^2) counts when > 0.

        Returns
        -------
        bool
            Whether it counts; if not, :attr:`faults` says why.
        """
        return kernels.push_altitude(self._memory, self._ints, stamp_ns, altitude, variance)

    @property
    def estimate(self):
        """Estimates after the last sample, as a copy."""
        return Estimates(self._ints[kernels.I_LAST_STAMP], _placed(self._row, self._valid))

    @property
    def free_fall(self):
        """Whether the last force is too small to show where down is."""
        force = np.linalg.norm(self._memory[kernels.FORCE:kernels.FORCE + 3])
        started = self._ints[kernels.I_CLOCK] == 1
        return bool(started and force < kernels.FREE_FALL_SHARE * self._params.local_gravity())

    @property
    def waiting_for(self):
        """What an attitude is missing while there is none."""
        if self._ints[kernels.I_CLOCK] == 0:
            return "a first good IMU sample: rate and force finite, in range and not all zero"
        return "a force of the size of gravity"

    @property
    def faults(self):
        """FaultCounts so far; those that only the default estimator looks for stay 0."""
        counts = dict.fromkeys(layout.FAULTS, 0)
        counts.update(zip(kernels.FAULTS, self._ints[kernels.I_COUNTS:].tolist(), strict=True))
        return FaultCounts(**counts)

    def warm_up(self):
        """Run each kernel of the streaming path once, so that it is compiled; then start anew."""
        for k in range(3):
            self.add_altitude(1 + k * 40_000_000, 0.0)
            self.add_imu(1 + k * 40_000_000, np.zeros(3), np.array([0.0, 0.0, -9.8]))
        self.reset()

    def run(self, imu, altitude=None, altitude_variance=None, *, actions=None):
        """Take a whole recording, or the next part of one; as :meth:`AttitudeEstimator.run`."""
        actions = np.zeros(len(imu), dtype=np.int64) if actions is None else np.asarray(actions)
        if altitude is None:
            stamps = arrival = np.zeros(0, dtype=np.int64)
            values = variances = np.zeros(0)
        else:
            stamps, values, arrival = altitude.stamp_ns, altitude.altitude, altitude.arrival
            variances = np.zeros(len(values)) if altitude_variance is None else altitude_variance
        rows, fresh = np.empty((len(imu), kernels.ROW_SIZE)), np.zeros(len(imu), dtype=bool)
        taken = kernels.run(self._memory, self._ints, imu.stamp_ns, imu.gyro_b, imu.accel_b, actions,
                            stamps, values, variances, arrival, rows, fresh)
        if fresh.any():
            self._valid = True
            self._row = rows[np.flatnonzero(fresh)[-1]].copy()
        if taken < len(imu):
            refuse_sample(self._ints[kernels.I_LAST_STAMP], imu.stamp_ns[taken], imu.gyro_b[taken], imu.accel_b[taken])
        return Estimates(imu.stamp_ns[fresh], _placed(rows[fresh], True)), fresh


def _placed(rows, valid):
    """Return rows of the kernels in the layout of :class:`Estimates`."""
    out = np.zeros((*rows.shape[:-1], layout.OUT_SIZE))
    out[..., _COLUMNS] = rows
    out[..., layout.OUT_VALID] = float(valid)
    return out
