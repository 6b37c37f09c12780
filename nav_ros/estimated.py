"""What a node or an offline tool has published, read back from its messages, in FRD and NED."""

from dataclasses import dataclass, replace

import numpy as np

from inertial.recording import AttitudeSeries
from inertial.rotation import dcm_from_quaternion, euler_from_dcm
from inertial.scoring import score_attitude
from nav_ros.bags import TOPICS, TYPES, BagError, BagReader, decoded
from nav_ros.frames import (
    q_nb_from_orientation,
    swap_enu_ned,
    swap_enu_ned_covariance,
    swap_flu_frd,
    swap_flu_frd_covariance,
)
from nav_ros.messages import (
    ACCEL,
    ACCEL_COVARIANCE,
    GYRO,
    GYRO_COVARIANCE,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    POSE_COVARIANCE,
    POSE_ORIENTATION,
    POSE_POSITION,
    TWIST_COVARIANCE,
    TWIST_LINEAR,
    UNKNOWN_VARIANCE,
)

ALSO = ("truth", "state", "odometry", "gyro_bias", "accel_bias")
"""Keys of :data:`nav_ros.bags.TOPICS` that a run may have beside its attitudes."""


@dataclass(frozen=True)
class AttitudeRun:
    """Estimated attitudes, with the truth where it is known.

    Attributes
    ----------
    stamp_ns : (N,) int64
    q_nb_wxyz : (N, 4)
    tilt_covariance_n : (N, 2, 2), rad^2
        Of the small rotation about north and east.
    valid : (N,) bool
        Where there is an attitude.
    gyro_b, accel_b : (N, 3), rad/s and m/s^2
        Without the biases.
    gyro_bias_std, accel_bias_std : (N, 3)
    truth : inertial.recording.AttitudeSeries or None
    """

    stamp_ns: np.ndarray
    q_nb_wxyz: np.ndarray
    tilt_covariance_n: np.ndarray
    valid: np.ndarray
    gyro_b: np.ndarray
    accel_b: np.ndarray
    gyro_bias_std: np.ndarray
    accel_bias_std: np.ndarray
    truth: AttitudeSeries | None = None

    def __len__(self):
        return len(self.stamp_ns)

    @property
    def roll_pitch(self):
        """Roll and pitch, (N, 2), rad."""
        return np.stack(euler_from_dcm(dcm_from_quaternion(self.q_nb_wxyz))[:2], axis=-1)

    @property
    def roll_pitch_std(self):
        """Standard deviations of roll and pitch, (N, 2), rad; NaN where there is no attitude.

        A small rotation ``e`` about north and east turns the angles by ``roll = (cos h e_n + sin h e_e) / cos p``
        and ``pitch = cos h e_e - sin h e_n``, with h the heading and p the pitch.
        """
        _, pitch, heading = euler_from_dcm(dcm_from_quaternion(self.q_nb_wxyz[self.valid]))
        ch, sh, cp = np.cos(heading), np.sin(heading), np.cos(pitch)
        jacobian = np.moveaxis(np.array([[ch / cp, sh / cp], [-sh, ch]]), -1, 0)
        deviations = np.full((len(self), 2), np.nan)
        deviations[self.valid] = np.sqrt(
            np.einsum("nij,njk,nik->ni", jacobian, self.tilt_covariance_n[self.valid], jacobian))
        return deviations

    @property
    def tilt_std(self):
        """Standard deviation of the tilt, (N,), rad; NaN where there is no attitude."""
        return np.where(self.valid, np.sqrt(np.abs(np.trace(self.tilt_covariance_n, axis1=-2, axis2=-1))), np.nan)

    def score(self):
        """Return the :class:`inertial.scoring.AttitudeScore`; raises ValueError as its maker does."""
        return score_attitude(self.stamp_ns, self.q_nb_wxyz, self.tilt_covariance_n, self.valid, self.truth)


@dataclass(frozen=True)
class PlaceRun:
    """Estimated positions and velocities; NaN where nobody knows.

    Attributes
    ----------
    stamp_ns : (N,) int64
    position_n, velocity_n : (N, 3), m and m/s
        Of ``attitude/state`` only what is vertical is known.
    position_std, velocity_std : (N, 3)
    """

    stamp_ns: np.ndarray
    position_n: np.ndarray
    position_std: np.ndarray
    velocity_n: np.ndarray
    velocity_std: np.ndarray


@dataclass(frozen=True)
class EstimatedRun:
    """All that a bag holds of a run; None what it does not.

    Attributes
    ----------
    name : str
    attitude : AttitudeRun
    state, odometry : PlaceRun or None
        Of ``attitude_node`` (vertical only) and of ``navigation_node``.
    gyro_bias, accel_bias : pair of (M,) int64 stamps and (M, 3), rad/s or m/s^2, FRD, or None
    """

    name: str
    attitude: AttitudeRun
    state: PlaceRun | None = None
    odometry: PlaceRun | None = None
    gyro_bias: tuple | None = None
    accel_bias: tuple | None = None


def attitude_run(raws, truth=None):
    """Return the :class:`AttitudeRun` of serialized sensor_msgs/Imu, whose orientation counts.

    Raises
    ------
    ValueError
        A message is malformed.
    """
    batch = decoded("output", raws)
    values = batch.values
    covariance_enu = values[:, ORIENTATION_COVARIANCE].reshape(-1, 3, 3)
    return AttitudeRun(
        batch.stamp_ns, q_nb_from_orientation(values[:, ORIENTATION]),
        swap_enu_ned_covariance(covariance_enu)[:, :2, :2], covariance_enu[:, 0, 0] >= 0.0,
        swap_flu_frd(values[:, GYRO]), swap_flu_frd(values[:, ACCEL]),
        _std(swap_flu_frd_covariance(values[:, GYRO_COVARIANCE].reshape(-1, 3, 3))),
        _std(swap_flu_frd_covariance(values[:, ACCEL_COVARIANCE].reshape(-1, 3, 3))), truth)


def read_run(path, topics=TOPICS, need=(), also=ALSO, progress=iter):
    """Read what was estimated, and the truth, from a bag.

    Parameters
    ----------
    path : path-like
    topics : dict
        Key -> topic, see :data:`nav_ros.bags.TOPICS`.
    need : tuple of str
        Keys that must be there beside ``output``.
    also : tuple of str
        Keys that are read where they are there.
    progress : callable
        Wraps the iteration over the messages.

    Returns
    -------
    EstimatedRun

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, a needed topic is not in it or of another type, a message is malformed.
    """
    with BagReader(path) as bag:
        if topics["output"] not in bag.types:
            raise BagError(f"{path}: no topic {topics['output']}, which estimate_bag and the nodes make of raw "
                           f"sensors; topics there: {', '.join(sorted(bag.types)) or 'none'}")
        keys = ["output", *need, *(key for key in also if topics[key] in bag.types)]
        for key in keys:
            bag.require(topics[key], TYPES[key])
        raws = {topics[key]: [] for key in keys}
        for message in progress(bag.messages(raws)):
            raws[message.topic].append(message.raw)
        name = bag.name
    parts = {}
    for key in keys:
        try:
            parts[key] = _READERS[key](raws[topics[key]])
        except ValueError as error:
            raise BagError(f"{path}: {topics[key]}: {error}") from error
    attitude = replace(parts.pop("output"), truth=parts.pop("truth", None))
    return EstimatedRun(name, attitude, **parts)


def _truth(raws):
    batch = decoded("truth", raws)
    return AttitudeSeries(batch.stamp_ns, q_nb_from_orientation(batch.values))


def _state(raws):
    batch = decoded("state", raws)
    covariance = swap_flu_frd_covariance(batch.values[:, TWIST_COVARIANCE].reshape(-1, 6, 6)[:, :3, :3])
    # Its child frame is level.
    return _places(batch, swap_flu_frd(batch.values[:, TWIST_LINEAR]), covariance)


def _odometry(raws):
    batch = decoded("odometry", raws)
    dcm_nb = dcm_from_quaternion(q_nb_from_orientation(batch.values[:, POSE_ORIENTATION]))
    velocity_n = np.einsum("nij,nj->ni", dcm_nb, swap_flu_frd(batch.values[:, TWIST_LINEAR]))
    covariance = swap_flu_frd_covariance(batch.values[:, TWIST_COVARIANCE].reshape(-1, 6, 6)[:, :3, :3])
    return _places(batch, velocity_n, np.einsum("nij,njk,nlk->nil", dcm_nb, covariance, dcm_nb))


def _places(batch, velocity_n, velocity_covariance_n):
    position_std = _std(swap_enu_ned_covariance(batch.values[:, POSE_COVARIANCE].reshape(-1, 6, 6)[:, :3, :3]))
    velocity_std = _std(velocity_covariance_n)
    return PlaceRun(
        batch.stamp_ns,
        np.where(np.isfinite(position_std), swap_enu_ned(batch.values[:, POSE_POSITION]), np.nan), position_std,
        np.where(np.isfinite(velocity_std), velocity_n, np.nan), velocity_std)


def _biases(raws):
    batch = decoded("gyro_bias", raws)
    return batch.stamp_ns, swap_flu_frd(batch.values)


def _std(covariance):
    """Square roots of the diagonals, NaN where they stand for unknown."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    return np.sqrt(np.where((variance >= 0.0) & (variance < 0.99 * UNKNOWN_VARIANCE), variance, np.nan))


_READERS = {"output": attitude_run, "truth": _truth, "state": _state, "odometry": _odometry,
            "gyro_bias": _biases, "accel_bias": _biases}
