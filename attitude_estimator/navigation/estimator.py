"""The navigator as a program sees it: samples and aids in, position, velocity and attitude out.

:class:`NavigationEstimator` levels itself by :class:`attitude_estimator.estimator.AttitudeEstimator`, finds the
heading from the velocity that the level force explains (or is told it), and then runs the filter of small errors
that its parameters name. Without position and velocity it goes on giving the attitude estimator's tilt. Every aid
counts at its stamp, also when it arrives late. Frames and units: :mod:`inertial`; positions are metres north, east
and down of the first fix.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from attitude_estimator import _kernels as level_kernels
from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.params import NavigationParams
from attitude_estimator.navigation.time_buffer import TimeBuffer
from inertial.earth import normal_gravity, radii_of_curvature
from inertial.rotation import down_from_quaternion

KINDS = kernels.KINDS[:-1]
"""What a measurement can be."""
NEVER = 1e9  # s since a measurement that has not come
UNKNOWN_VARIANCE = kernels.UNKNOWN_VARIANCE
"""Variance of what is not known, in the unit of its entry."""

TILT_CORRELATION = 20.0
"""Seconds that an error of the level estimator's tilt lasts."""
_FAULTS = ("measurement_late", "measurement_ahead", "measurement_duplicate", "restarted", "heading_lost")


def _columns(*fields):
    return np.concatenate([np.arange(start, start + size) for start, size in fields])


# Where the level estimator's row has what the kernels take of it, in their order.
_LEVEL = _columns(
    (level_kernels.OUT_VALID, 1), (level_kernels.OUT_Q, 4), (level_kernels.OUT_TILT_COV, 3),
    (level_kernels.OUT_VD, 1), (level_kernels.OUT_ALT, 1), (level_kernels.OUT_VD_VAR, 1),
    (level_kernels.OUT_ALT_VAR, 1), (level_kernels.OUT_BG, 3), (level_kernels.OUT_BA, 3),
    (level_kernels.OUT_BG_VAR, 3), (level_kernels.OUT_BA_VAR, 3), (level_kernels.OUT_GYRO, 3),
    (level_kernels.OUT_ACCEL, 3))


@dataclass(frozen=True)
class Navigation:
    """Estimates after one sample (leading dimensions dropped) or after each of N samples.

    Attributes
    ----------
    stamp_ns : (N,) int64
    valid : (N,) bool
        Whether roll and pitch are known.
    heading_known : (N,) bool
    navigating : (N,) bool
        Whether the filter of small errors runs; before, position and velocity are those of the start.
    q_nb_wxyz : (N, 4)
    velocity_n, position_n : (N, 3), m/s and m
    covariance : (N, 9, 9)
        Of the small rotation about the navigation axes, velocity and position; UNKNOWN_VARIANCE where unknown.
    gyro_bias_b, accel_bias_b, gyro_bias_variance, accel_bias_variance : (N, 3)
    gyro_b, accel_b : (N, 3)
        The sample with the bias removed.
    altimeter_zero : (N,), m
    """

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
    def heading_known(self):
        return self.rows[..., kernels.OUT_HEADING] > 0.0

    @property
    def navigating(self):
        return self.rows[..., kernels.OUT_NAVIGATING] > 0.0

    @property
    def q_nb_wxyz(self):
        return self._columns(kernels.OUT_Q, 4)

    @property
    def velocity_n(self):
        return self._columns(kernels.OUT_V, 3)

    @property
    def position_n(self):
        return self._columns(kernels.OUT_P, 3)

    @property
    def covariance(self):
        return self._columns(kernels.OUT_COV, 81).reshape(*self.rows.shape[:-1], 9, 9)

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

    @property
    def altimeter_zero(self):
        return self.rows[..., kernels.OUT_REF]


@dataclass(frozen=True)
class SensorHealth:
    """What became of the measurements of one kind.

    Attributes
    ----------
    used, refused : int
    nis : float
        Running mean of the normalised squared innovation of each component; ideally 1, NaN before the first.
    age : float, s
        Since the last one that was used, infinite before.
    """

    used: int
    refused: int
    nis: float
    age: float


class NavigationEstimator:
    """Position, velocity and attitude from one IMU and the aids that there are.

    Parameters
    ----------
    params : NavigationParams, optional
    """

    def __init__(self, params=None):
        self._memory = np.zeros(kernels.MEMORY_SIZE)
        self._row = np.zeros(kernels.OUT_SIZE)
        self._counts = Counter(dict.fromkeys(_FAULTS, 0))
        self._buffer = TimeBuffer(self._memory[:kernels.STATE_SIZE], kernels.H_SIZE, self._carry, self._take)
        self._level = None
        self.params = NavigationParams() if params is None else params
        self.reset()

    @property
    def params(self):
        """NavigationParams in use; setting them keeps the state."""
        return self._params

    @params.setter
    def params(self, params):
        self._params = params
        if self._level is None:
            self._level = AttitudeEstimator(params.level_params())
        else:
            self._level.params = params.level_params()
        self._memory[kernels.M_PARAMETERS:kernels.M_EARTH] = params.flat(kernels.PARAMETER_NAMES)

    def reset(self):
        """Forget everything but the fault counters, and start levelling; the next fix is the origin."""
        self._level.reset()
        self._origin = None
        self._memory[kernels.M_EARTH] = 0.0
        self._memory[kernels.P_GRAVITY] = self._params.local_gravity()
        self._restart()

    def _restart(self):
        state = self._memory[:kernels.STATE_SIZE]
        state[:] = 0.0
        state[kernels.X_Q] = 1.0
        state[kernels.X_SINCE:kernels.X_NIS] = NEVER
        kernels.start_blind(self._memory)
        self._buffer.clear()

    @property
    def origin(self):
        """Latitude, longitude (rad) and height (m) of the first fix, or None."""
        return self._origin

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
        attitude_estimator.estimator.TimeJumpError
            When the stamp is not later than the one before.
        """
        if not self._level.add_imu(stamp_ns, gyro_b, accel_b):
            return False
        level = self._level.estimate.rows[_LEVEL]
        dt = (stamp_ns - self._buffer.last_ns) * 1e-9
        if len(self._buffer) and dt > self._params.gap_limit:
            self._counts["restarted"] += 1
            self._restart()
        row = self._buffer.next_row
        kernels.fill_row(self._memory, level, dt, bool(np.abs(accel_b).max() <= self._params.accel_range), row)
        if len(self._buffer):
            self._buffer.add(stamp_ns)
            self._change_phase(stamp_ns, level)
        else:
            self._memory[kernels.X_GYRO_LP:kernels.X_GYRO_SPREAD] = row[kernels.H_GYRO:kernels.H_ACCEL_VAR]
            self._buffer.begin(stamp_ns)
        kernels.write_output(self._memory, level, row, self._row)
        return True

    def _carry(self, row):
        kernels.carry(self._memory, row)

    def _take(self, measurement, age, row):
        kernels.take(self._memory, *measurement, age, row[kernels.H_YAW])

    def _change_phase(self, stamp_ns, level):
        done = kernels.change_phase(self._memory, level)
        if done == kernels.TILT:
            self._take_level_tilt(stamp_ns, level)
        elif done != kernels.NOTHING:
            self._counts["heading_lost"] += done == kernels.LOST
            self._buffer.begin(stamp_ns)

    def _take_level_tilt(self, stamp_ns, level):
        """Where nothing else shows the tilt, take that of the level estimator now and then."""
        q_nb_wxyz, (nn, _, ee) = np.split(level[kernels.L_Q:kernels.L_VD], [4])
        variance = 0.5 * (nn + ee) * TILT_CORRELATION / kernels.TILT_PERIOD
        self._insert(stamp_ns, kernels.K_LEVEL, down_from_quaternion(q_nb_wxyz), np.eye(3) * variance)

    def add_fix(self, stamp_ns, latitude, longitude, height, covariance_n=None):
        """Take a fix of the antenna: rad, rad, m above the ellipsoid, covariance (3, 3) m^2 in NED.

        Returns
        -------
        bool
            Whether it counts; if not, :attr:`faults` or :attr:`health` says why.

        Raises
        ------
        ValueError
            Something is not finite or out of range, or the covariance is no covariance.
        """
        if not (abs(latitude) <= np.pi / 2 and abs(longitude) <= 2 * np.pi and abs(height) < 1e6):
            raise ValueError(f"fix at latitude {latitude} rad, longitude {longitude} rad, height {height} m: "
                             "not a place")
        if self._origin is None:
            self._set_origin(latitude, longitude, height)
        latitude0, longitude0, height0 = self._origin
        _, _, meridian, transverse = self._memory[kernels.M_EARTH:]
        east = np.remainder(longitude - longitude0 + np.pi, 2 * np.pi) - np.pi
        position_n = np.array([(latitude - latitude0) * meridian, east * transverse * np.cos(latitude0),
                               height0 - height])
        return self._add(stamp_ns, kernels.K_FIX, position_n, covariance_n, self._params.fix_std)

    def add_position(self, stamp_ns, position_n, covariance_n=None):
        """Take a position of the antenna in metres of a local flat NED frame, in place of fixes; as add_fix."""
        return self._add(stamp_ns, kernels.K_FIX, position_n, covariance_n, self._params.fix_std)

    def add_velocity(self, stamp_ns, velocity_n, covariance_n=None):
        """Take a velocity of the antenna, (3,) m/s NED, covariance (3, 3); as :meth:`add_fix`."""
        return self._add(stamp_ns, kernels.K_VELOCITY, velocity_n, covariance_n, self._params.velocity_std)

    def add_altitude(self, stamp_ns, altitude, variance=0.0):
        """Take an altitude of the IMU, m up above an unknown level, variance m^2 where > 0; as add_fix."""
        counts = self._level.add_altitude(stamp_ns, altitude, variance)
        if not counts:
            return False
        covariance = np.eye(3) * (variance if variance > 0.0 else self._params.altitude_std**2)
        stamp_ns -= round(self._params.altitude_delay * 1e9)
        return self._insert(stamp_ns, kernels.K_ALTITUDE, np.full(3, altitude), covariance)

    def add_inclinometer(self, stamp_ns, down_b):
        """Take the down direction in body axes, (3,); its length does not matter; as :meth:`add_fix`."""
        down_b = np.asarray(down_b, float)
        norm = np.linalg.norm(down_b)
        if not 0.0 < norm < np.inf:
            raise ValueError(f"down_b = {down_b}: not a direction")
        return self._add(stamp_ns, kernels.K_INCLINOMETER, down_b / norm, None, self._params.inclinometer_std)

    def add_heading(self, stamp_ns, heading, variance=0.0):
        """Take a heading, rad clockwise from north, variance rad^2 where > 0; as :meth:`add_fix`."""
        covariance = np.eye(3) * variance if variance > 0.0 else None
        return self._add(stamp_ns, kernels.K_HEADING, np.full(3, heading), covariance, self._params.heading_std)

    def _add(self, stamp_ns, kind, value, covariance, std):
        value = np.ascontiguousarray(value, float)
        covariance = np.eye(3) * std**2 if covariance is None else np.ascontiguousarray(covariance, float)
        if not np.isfinite(value).all():
            raise ValueError(f"{kernels.KINDS[kind]} = {value}: must be finite")
        if not (np.isfinite(covariance).all() and (np.diagonal(covariance) > 0.0).all()):
            raise ValueError(f"{kernels.KINDS[kind]} covariance has a diagonal of {np.diagonal(covariance)}: "
                             "must be positive")
        return self._insert(stamp_ns, kind, value, covariance)

    def _insert(self, stamp_ns, kind, value, covariance):
        if not len(self._buffer):
            return False
        fault = self._buffer.insert(stamp_ns, (kind, value, covariance), round(self._params.measurement_buffer * 1e9))
        if fault:
            self._counts[f"measurement_{fault}"] += 1
        return not fault

    def _set_origin(self, latitude, longitude, height):
        self._origin = latitude, longitude, height
        meridian, transverse = radii_of_curvature(latitude)
        self._memory[kernels.M_EARTH:] = [1.0, latitude, meridian + height, transverse + height]
        if np.isnan(self._params.gravity):
            self._memory[kernels.P_GRAVITY] = normal_gravity(latitude, height)

    @property
    def estimate(self):
        """Navigation after the last sample, as a copy."""
        return Navigation(self._buffer.last_ns, self._row.copy())

    @property
    def health(self):
        """Kind of measurement -> SensorHealth."""
        m = self._memory
        used, refused = m[kernels.X_USED:kernels.X_REFUSED], m[kernels.X_REFUSED:kernels.X_REFUSING]
        return {name: SensorHealth(int(used[k]), int(refused[k]),
                                   float(m[kernels.X_NIS + k]) if used[k] + refused[k] else np.nan,
                                   float(m[kernels.X_SINCE + k]) if m[kernels.X_SINCE + k] < NEVER else np.inf)
                for k, name in enumerate(kernels.KINDS)}

    @property
    def faults(self):
        """Name -> how often each fault of the aids was seen since the estimator was made."""
        return dict(self._counts)

    @property
    def level_faults(self):
        """FaultCounts of the IMU and the altimeter so far."""
        return self._level.faults

    @property
    def free_fall(self):
        """Whether the low-passed force is too small to show where down is."""
        return self._level.free_fall

    @property
    def waiting_for(self):
        """What is missing while nothing navigates."""
        if not self.estimate.valid:
            return self._level.waiting_for
        if not self.estimate.heading_known:
            return "a heading: a velocity that changes, or the heading topic"
        return "velocity"

    def warm_up(self):
        """Run each kernel once, so that it is compiled; then start anew."""
        for k in range(4):
            self.add_imu(1 + k * 40_000_000, np.zeros(3), np.array([0.0, 0.0, -9.8]))
            self.add_altitude(1 + k * 40_000_000, 0.0)
            self.add_velocity(1 + k * 40_000_000, np.zeros(3))
        self.reset()
        self._counts.update(dict.fromkeys(self._counts, 0))
