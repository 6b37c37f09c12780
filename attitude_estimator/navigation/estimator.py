"""The navigator as a program sees it: samples and aids in, position, velocity and attitude out.

:class:`NavigationEstimator` levels itself by :class:`attitude_estimator.estimator.AttitudeEstimator`, finds the
heading from the velocity that the level force explains (or is told it), and then runs the filter of small errors
that its parameters name. Without position and velocity it goes on giving the attitude estimator's tilt. Every aid
counts at its stamp, also when it arrives late. Frames and units: :mod:`inertial`; positions are metres north, east
and down of the first fix that the next one confirms.
"""

from dataclasses import dataclass, field

import numpy as np

from attitude_estimator import _kernels as level_kernels
from attitude_estimator.estimator import ACTION_RESET, AttitudeEstimator
from attitude_estimator.navigation import _kernels as kernels
from attitude_estimator.navigation.params import NavigationParams
from inertial.earth import normal_gravity, radii_of_curvature
from inertial.recording import AltitudeSeries, ImuSeries

UNKNOWN_VARIANCE = kernels.UNKNOWN_VARIANCE
"""Variance of what is not known, in the unit of its entry."""

ORIGIN_SPREAD, ORIGIN_SPEED = 5.0, 400.0
"""Sigmas, and m/s of travel, by which two fixes may differ and confirm each other."""


def _columns(*fields):
    return np.concatenate([np.arange(start, start + size) for start, size in fields])


# Where the level estimator's row has what the kernels take of it, in their order between L_DT and L_KNOWN.
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


@dataclass
class _Held:
    """What waits for a run: samples, altitudes of the level estimator, aids, each with the samples before it."""

    stamps: list = field(default_factory=list)
    gyro_b: list = field(default_factory=list)
    accel_b: list = field(default_factory=list)
    altitudes: list = field(default_factory=list)
    aids: list = field(default_factory=list)
    resets: list = field(default_factory=list)
    count: int = 0


class NavigationEstimator:
    """Position, velocity and attitude from one IMU and the aids that there are.

    Parameters
    ----------
    params : NavigationParams, optional
    """

    def __init__(self, params=None):
        self._memory = np.zeros(kernels.MEMORY_SIZE)
        self._ints = self._memory[kernels.M_INTS:kernels.M_HISTORY].view(np.int64)
        self._rows = np.zeros((1, kernels.OUT_SIZE))
        self._level, self._held, self._origin, self._last_ns = None, None, None, 0
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
        self._memory[kernels.P_GRAVITY] = self._gravity()

    def reset(self):
        """Forget everything but the fault counters, and start levelling; the next fixes give the origin."""
        self._origin = self._candidate = None
        if self._held is None:
            self._level.reset()
            self._rows[:] = 0.0
            self._last_ns = 0
        else:
            self._held.resets.append(self._held.count)
        self._take(0, kernels.K_RESET, [0.0, 0.0, self._gravity()])

    @property
    def level(self):
        """The AttitudeEstimator that levels the start."""
        return self._level

    @property
    def origin(self):
        """Latitude, longitude (rad) and height (m) of the first fix that the next one confirmed, or None."""
        return self._origin

    def _gravity(self):
        if self._origin is None or not np.isnan(self._params.gravity):
            return self._params.local_gravity()
        latitude, _, height = self._origin
        return float(normal_gravity(latitude, height))

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
            Whether :attr:`estimate` is new; True while samples are held.

        Raises
        ------
        attitude_estimator.estimator.TimeJumpError
            When the stamp is not later than the one before.
        """
        if self._held is not None:
            held = self._held
            held.stamps.append(stamp_ns)
            held.gyro_b.append(gyro_b)
            held.accel_b.append(accel_b)
            held.count += 1
            return True
        if not self._level.add_imu(stamp_ns, gyro_b, accel_b):
            return False
        level = self._level.estimate.rows[None]
        self._rows = self._run(np.array([stamp_ns]), np.asarray(accel_b)[None], level, _NO_AIDS)
        return True

    def _run(self, stamp_ns, accel_b, level_rows, aids):
        """Return the rows of output of samples and aids in recorded order."""
        samples = np.zeros((len(stamp_ns), kernels.L_SIZE))
        samples[:, kernels.L_VALID:kernels.L_KNOWN] = level_rows[:, _LEVEL]
        samples[:, kernels.L_KNOWN] = np.abs(accel_b).max(axis=1) <= self._params.accel_range
        rows = np.empty((len(stamp_ns), kernels.OUT_SIZE))
        done = np.empty(len(aids.arrival), np.int64)
        kernels.run(self._memory, stamp_ns, samples, aids.stamp_ns, aids.rows, aids.arrival, rows, done)
        if len(stamp_ns):
            self._last_ns = int(stamp_ns[-1])
        return rows

    # --- a recording at once

    def hold(self):
        """Let all that is given from now on wait for :meth:`release`, which takes it at once."""
        self._held = _Held()

    def release(self):
        """Take what was held, in the order in which it came, as if it had not been held.

        Returns
        -------
        navigation : Navigation
            One for each sample that gave output.
        fresh : (N,) bool
            Which samples did.

        Raises
        ------
        attitude_estimator.estimator.TimeJumpError
            When a stamp is not later than the one before.
        """
        held, self._held = self._held, None
        imu = ImuSeries(np.array(held.stamps, np.int64), np.array(held.gyro_b, float).reshape(-1, 3),
                        np.array(held.accel_b, float).reshape(-1, 3))
        return self._run_all(imu, held)

    def run(self, recording):
        """Take a whole recording's IMU, altitudes, fixes and velocities in recorded order.

        Parameters
        ----------
        recording : inertial.recording.Recording

        Returns
        -------
        navigation : Navigation
        fresh : (N,) bool
        As of :meth:`release`.
        """
        self._held = held = _Held()
        events = []
        if recording.altitude is not None:
            events += [(self.add_altitude, *event) for event in zip(
                recording.altitude.arrival, recording.altitude.stamp_ns, recording.altitude.altitude, strict=True)]
        if recording.fix is not None:
            fix = recording.fix
            events += [(self.add_fix, *event, fix.covariance_n) for event in zip(
                fix.arrival, fix.stamp_ns, fix.latitude, fix.longitude, fix.height, strict=True)
                if np.isfinite(event[2])]
        if recording.velocity is not None:
            velocity = recording.velocity
            events += [(self.add_velocity, *event, velocity.covariance_n) for event in zip(
                velocity.arrival, velocity.stamp_ns, velocity.velocity_n, strict=True)]
        for add, arrival, stamp_ns, *measured in sorted(events, key=lambda event: event[1]):
            held.count = min(int(arrival), len(recording.imu))
            add(int(stamp_ns), *measured)
        self._held = None
        return self._run_all(recording.imu, held)

    def _run_all(self, imu, held):
        actions = np.zeros(len(imu), np.int64)
        actions[[k for k in held.resets if k < len(imu)]] = ACTION_RESET
        arrival, stamps, altitudes, variances = (np.array(part) for part in zip(*held.altitudes, strict=True)) \
            if held.altitudes else np.zeros((4, 0))
        altitude = AltitudeSeries(stamps.astype(np.int64), altitudes.astype(float), arrival.astype(np.int64))
        level, fresh = self._level.run(imu, altitude, variances.astype(float), actions=actions)
        before = np.concatenate([[0], np.cumsum(fresh)])
        aids = _aids([(before[arrival], stamp_ns, row) for arrival, stamp_ns, row in held.aids])
        rows = self._run(imu.stamp_ns[fresh], imu.accel_b[fresh], level.rows, aids)
        if len(rows):
            self._rows = rows[-1:].copy()
        return Navigation(imu.stamp_ns[fresh], rows), fresh

    # --- what aids it

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
        if covariance_n is None:
            covariance_n = np.eye(3) * self._params.fix_std**2
        if self._origin is None and not self._find_origin(stamp_ns, (latitude, longitude, height), covariance_n):
            return False
        position_n = _metres_from(self._origin, latitude, longitude, height)
        return self._add(stamp_ns, kernels.K_FIX, position_n, covariance_n, self._params.fix_std)

    def _find_origin(self, stamp_ns, place, covariance_n):
        """Return whether there is an origin now: the last fix, where this one is near it."""
        before, self._candidate = self._candidate, (stamp_ns, place, np.trace(covariance_n))
        if before is None:
            return False
        before_ns, origin, variance = before
        apart = np.linalg.norm(_metres_from(origin, *place))
        near = ORIGIN_SPREAD * np.sqrt(variance + np.trace(covariance_n)) \
            + ORIGIN_SPEED * abs(stamp_ns - before_ns) * 1e-9
        if not apart < near:
            return False
        self._origin = origin
        self._take(0, kernels.K_ORIGIN, [origin[0], origin[2], self._gravity()])
        return True

    def add_position(self, stamp_ns, position_n, covariance_n=None):
        """Take a position of the antenna in metres of a local flat NED frame, in place of fixes; as add_fix."""
        return self._add(stamp_ns, kernels.K_FIX, position_n, covariance_n, self._params.fix_std)

    def add_velocity(self, stamp_ns, velocity_n, covariance_n=None):
        """Take a velocity of the antenna, (3,) m/s NED, covariance (3, 3); as :meth:`add_fix`."""
        return self._add(stamp_ns, kernels.K_VELOCITY, velocity_n, covariance_n, self._params.velocity_std)

    def add_altitude(self, stamp_ns, altitude, variance=0.0):
        """Take an altitude of the IMU, m up above an unknown level, variance m^2 where > 0; as add_fix."""
        if self._held is None:
            self._level.add_altitude(stamp_ns, altitude, variance)
        else:
            self._held.altitudes.append((self._held.count, stamp_ns, altitude, variance))
        if not np.isfinite(altitude):
            return False
        covariance = np.eye(3) * (variance if variance > 0.0 else self._params.altitude_std**2)
        stamp_ns -= round(self._params.altitude_delay * 1e9)
        return self._take(stamp_ns, kernels.K_ALTITUDE, np.full(3, altitude), covariance)

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
        return self._take(stamp_ns, kind, value, covariance)

    def _take(self, stamp_ns, kind, value, covariance=0.0):
        """Take or hold a measurement; return whether it counts."""
        row = np.empty(kernels.A_SIZE)
        row[kernels.A_KIND] = kind
        row[kernels.A_VALUE:kernels.A_COV] = value
        row[kernels.A_COV:] = np.ravel(covariance)
        if self._held is not None:
            self._held.aids.append((self._held.count, stamp_ns, row))
            return True
        done = np.empty(1, np.int64)
        kernels.run(self._memory, _NO_STAMPS, _NO_SAMPLES, np.array([stamp_ns]), row[None], _ZERO, _NO_ROWS, done)
        return bool(done[0] == kernels.COUNTS)

    @property
    def estimate(self):
        """Navigation after the last sample, as a copy."""
        return Navigation(self._last_ns, self._rows[0].copy())

    @property
    def health(self):
        """Kind of measurement -> SensorHealth."""
        m, never = self._memory, kernels.NEVER
        used, refused = m[kernels.X_USED:kernels.X_REFUSED], m[kernels.X_REFUSED:kernels.X_REFUSING]
        return {name: SensorHealth(int(used[k]), int(refused[k]),
                                   float(m[kernels.X_NIS + k]) if used[k] + refused[k] else np.nan,
                                   float(m[kernels.X_SINCE + k]) if m[kernels.X_SINCE + k] < never else np.inf)
                for k, name in enumerate(kernels.KINDS)}

    @property
    def faults(self):
        """Name -> how often each fault of the aids was seen since the estimator was made."""
        counts = self._ints[kernels.I_FAULTS:kernels.I_STAMPS].tolist()
        counts[kernels.F_LOST] += int(self._memory[kernels.X_LOST])
        return dict(zip(kernels.FAULTS, counts, strict=True))

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
        """Run the kernels once, so that they are compiled; then start anew."""
        self._level.warm_up()
        self.reset()


@dataclass(frozen=True)
class _Aids:
    """Measurements as the kernels take them."""

    stamp_ns: np.ndarray
    rows: np.ndarray
    arrival: np.ndarray


def _aids(held):
    """Return the Aids of a list of (arrival, stamp, row)."""
    arrival, stamps, rows = zip(*held, strict=True) if held else ((), (), ())
    return _Aids(np.array(stamps, np.int64), np.array(rows, float).reshape(-1, kernels.A_SIZE),
                 np.array(arrival, np.int64))


_NO_AIDS = _aids([])
_NO_STAMPS, _ZERO = np.zeros(0, np.int64), np.zeros(1, np.int64)
_NO_SAMPLES, _NO_ROWS = np.zeros((0, kernels.L_SIZE)), np.zeros((0, kernels.OUT_SIZE))


def _metres_from(origin, latitude, longitude, height):
    """Return how far north, east and down a place is of the origin, along its meridian and parallel, (3,) m."""
    latitude0, longitude0, height0 = origin
    meridian, transverse = radii_of_curvature(latitude0)
    east = np.remainder(longitude - longitude0 + np.pi, 2 * np.pi) - np.pi
    return np.array([(latitude - latitude0) * (meridian + height0),
                     east * (transverse + height0) * np.cos(latitude0), height0 - height])
