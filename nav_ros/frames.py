"""The one place where ROS frames meet those of the filters: FLU and ENU against FRD and NED.

Both changes of axes are their own inverse, so each function serves in either direction::

    FLU <-> FRD   [x, y, z] -> [x, -y, -z]       half a turn about forward
    ENU <-> NED   [x, y, z] -> [y, x, -z]        half a turn about north-east

An orientation in ROS takes body FLU to world ENU, with its quaternion x, y, z, w; ours, ``q_nb_wxyz``, takes
body FRD to NED with w first. All functions take any number of leading axes.

Sources: REP-103 (axes), REP-145 (IMU data and orientation).
"""

import numpy as np

from inertial.rotation import dcm_nb_from_euler, quaternion_conjugate, quaternion_from_dcm, quaternion_multiply

_FLIP = np.array([1.0, -1.0, -1.0])
_ENU = [1, 0, 2]
_ENU_SIGN = np.array([1.0, 1.0, -1.0])


def swap_flu_frd(v):
    """Return a vector given in body FLU in body FRD, or the reverse.

    Parameters
    ----------
    v : (..., 3) array_like

    Returns
    -------
    (..., 3) float64
    """
    return np.asarray(v, float) * _FLIP


def swap_enu_ned(v):
    """Return a vector given in ENU in NED, or the reverse; shapes as :func:`swap_flu_frd`."""
    return np.asarray(v, float)[..., _ENU] * _ENU_SIGN


def swap_flu_frd_covariance(covariance):
    """Return a (..., 3, 3) covariance given in body FLU in body FRD, or the reverse."""
    return np.asarray(covariance, float) * np.outer(_FLIP, _FLIP)


def swap_enu_ned_covariance(covariance):
    """Return a (..., 3, 3) covariance given in ENU in NED, or the reverse.

    A covariance of small rotations about the world's axes changes like that of a vector.
    """
    return np.asarray(covariance, float)[..., _ENU, :][..., _ENU] * np.outer(_ENU_SIGN, _ENU_SIGN)


def orientation_from_q_nb(q_nb_wxyz):
    """Return the ROS orientation of an attitude.

    ``q = q_enu_ned * q_nb * q_frd_flu`` with ``q_enu_ned = (0, 1, 1, 0)/sqrt(2)`` and
    ``q_frd_flu = (0, 1, 0, 0)``, multiplied out; the common sign is chosen to keep w where it was.

    Parameters
    ----------
    q_nb_wxyz : (..., 4) array_like

    Returns
    -------
    (..., 4) float64
        x, y, z, w, body FLU to world ENU. Level and facing north is a yaw of +90 deg.
    """
    w, x, y, z = np.moveaxis(np.asarray(q_nb_wxyz, float), -1, 0)
    return np.stack([x + y, x - y, w - z, w + z], axis=-1) * np.sqrt(0.5)


def q_nb_from_orientation(orientation_xyzw):
    """Return ``q_nb_wxyz`` of a ROS orientation, the inverse of :func:`orientation_from_q_nb`.

    Parameters
    ----------
    orientation_xyzw : (..., 4) array_like

    Returns
    -------
    (..., 4) float64
    """
    x, y, z, w = np.moveaxis(np.asarray(orientation_xyzw, float), -1, 0)
    return np.stack([w + z, x + y, x - y, w - z], axis=-1) * np.sqrt(0.5)


def rpy_from_euler(roll, pitch, heading):
    """Return roll, pitch and yaw as ROS has them (FLU in ENU) from those of FRD in NED.

    Parameters
    ----------
    roll, pitch, heading : float or array_like, rad
        Right wing down, nose up, clockwise from north.

    Returns
    -------
    (..., 3) float64, rad
        Right side down, nose **down**, counter-clockwise from east within [-pi, pi).
    """
    yaw = np.mod(1.5 * np.pi - np.asarray(heading, float), 2.0 * np.pi) - np.pi
    return np.stack(np.broadcast_arrays(roll, np.negative(pitch), yaw), axis=-1)


class Mounting:
    """How an IMU sits in its vehicle.

    Parameters
    ----------
    rpy : (3,), rad
        Roll, pitch and yaw of the IMU in the vehicle, FLU.

    Attributes
    ----------
    dcm_base_imu : (3, 3)
        Takes the IMU's axes to the vehicle's, both FRD.
    """

    def __init__(self, rpy):
        roll, pitch, yaw = rpy
        # FLU roll, pitch, yaw are those of FRD with pitch and yaw reversed.
        self.dcm_base_imu = dcm_nb_from_euler(roll, -pitch, -yaw)
        self._q_imu_base = quaternion_conjugate(quaternion_from_dcm(self.dcm_base_imu))

    @property
    def up_imu(self):
        """The vehicle's up direction in the IMU's axes, FLU, list of three."""
        return swap_flu_frd(-self.dcm_base_imu[2]).tolist()

    def attitude(self, q_nb_wxyz):
        """Return the vehicle's attitude where the IMU's is given, (..., 4)."""
        return quaternion_multiply(q_nb_wxyz, self._q_imu_base)

    def vector(self, vector_imu):
        """Return a vector (..., 3) in the IMU's axes, FRD, in the vehicle's, FLU."""
        return swap_flu_frd(vector_imu @ self.dcm_base_imu.T)

    def covariance(self, variance_imu):
        """Return the (..., 3, 3) in the vehicle's axes, FLU, of variances (..., 3) along the IMU's."""
        dcm = self.dcm_base_imu
        return swap_flu_frd_covariance(np.einsum("ij,...j,kj->...ik", dcm, variance_imu, dcm))
