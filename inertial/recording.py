"""What a run of sensors leaves behind: IMU samples, what aids them and, where known, the true attitude.

A simulator makes a :class:`Recording`, a bag is read into one, and estimators and scores take one,
so simulated and real data go the same way. Frames and units: see :mod:`inertial`.
"""

from dataclasses import dataclass

import numpy as np


def _check_stamps(series):
    stamp_ns = np.asarray(series.stamp_ns)
    if stamp_ns.ndim != 1 or (len(stamp_ns) and stamp_ns.dtype.kind not in "iu"):
        raise ValueError(f"stamp_ns is {stamp_ns.dtype} of shape {stamp_ns.shape}: must be (N,) integers, nanoseconds")
    object.__setattr__(series, "stamp_ns", np.ascontiguousarray(stamp_ns, np.int64))


def _check_column(series, name, dtype, width):
    """Make a field what compiled code takes, which looks at neither type nor shape itself."""
    values = np.ascontiguousarray(getattr(series, name), dtype)
    if not len(values) and not len(series.stamp_ns):
        values = values.reshape(0, *width)
    if values.shape != (len(series.stamp_ns), *width):
        raise ValueError(f"{name} has shape {values.shape}, expected {(len(series.stamp_ns), *width)}")
    object.__setattr__(series, name, values)


@dataclass(frozen=True)
class ImuSeries:
    """IMU samples in the order received.

    Attributes
    ----------
    stamp_ns : (N,) int64
    gyro_b : (N, 3) float64, rad/s, FRD
    accel_b : (N, 3) float64, specific force, m/s^2, FRD

    Raises
    ------
    ValueError
        Naming the field that has another shape, or stamps that are not integers.
    """

    stamp_ns: np.ndarray
    gyro_b: np.ndarray
    accel_b: np.ndarray

    def __post_init__(self):
        _check_stamps(self)
        _check_column(self, "gyro_b", np.float64, (3,))
        _check_column(self, "accel_b", np.float64, (3,))

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class AltitudeSeries:
    """Altimeter samples in the order received.

    Attributes
    ----------
    stamp_ns : (M,) int64, when each value was valid
    altitude : (M,) float64, m, up
    arrival : (M,) int64, how many IMU samples had been received before each value

    Raises
    ------
    ValueError
        As for :class:`ImuSeries`.
    """

    stamp_ns: np.ndarray
    altitude: np.ndarray
    arrival: np.ndarray

    def __post_init__(self):
        _check_stamps(self)
        _check_column(self, "altitude", np.float64, ())
        _check_column(self, "arrival", np.int64, ())

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class AttitudeSeries:
    """Attitudes with their stamps.

    Attributes
    ----------
    stamp_ns : (K,) int64
    q_nb_wxyz : (K, 4) float64
    """

    stamp_ns: np.ndarray
    q_nb_wxyz: np.ndarray

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class JointSeries:
    """Angles of a turntable with their stamps.

    Attributes
    ----------
    stamp_ns : (K,) int64
    angle : (K,) float64, rad, clockwise seen from above (about z, down)
    """

    stamp_ns: np.ndarray
    angle: np.ndarray

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class FixSeries:
    """Positions from a satellite receiver in the order received.

    Attributes
    ----------
    stamp_ns : (M,) int64, when each was valid
    latitude, longitude : (M,) float64, rad, NaN where the receiver says that it has none
    height : (M,) float64, m above the ellipsoid
    covariance_n : (3, 3), m^2
        Of each, in NED.
    arrival : (M,) int64, how many IMU samples had been received before each
    """

    stamp_ns: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    height: np.ndarray
    covariance_n: np.ndarray
    arrival: np.ndarray

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class VelocitySeries:
    """Velocities over ground in the order received.

    Attributes
    ----------
    stamp_ns : (M,) int64, when each was valid
    velocity_n : (M, 3) float64, m/s
    covariance_n : (3, 3), (m/s)^2
        Of each.
    arrival : (M,) int64, how many IMU samples had been received before each
    """

    stamp_ns: np.ndarray
    velocity_n: np.ndarray
    covariance_n: np.ndarray
    arrival: np.ndarray

    def __len__(self):
        return len(self.stamp_ns)


@dataclass(frozen=True)
class Recording:
    """One run: the IMU and, where there are any, its aids, the truth, a turntable's angle."""

    name: str
    imu: ImuSeries
    altitude: AltitudeSeries | None = None
    truth: AttitudeSeries | None = None
    joint: JointSeries | None = None
    fix: FixSeries | None = None
    velocity: VelocitySeries | None = None
