"""Strapdown navigation: attitude, velocity and position from gyros and accelerometers alone.

Source: the algorithm of figures 2.3 and 2.4 of "Inertial navigation algorithm" (in Vietnamese, chapters 2.6 to
3.1 of a thesis), "the paper" below, on the WGS84 ellipsoid. As a sample flows through:

1. sensor errors out (:class:`inertial.imu_errors.Calibration`);
2. increments of angle ``alpha_i`` and velocity ``nu_i`` over a sample interval, the paper's hN1;
3. coning and sculling over a major interval of one to four samples, hN3::

       phi = sum alpha_i + (sum k_i alpha_i) x alpha_last
       eta = sum nu_i + (sum k_i alpha_i) x nu_last + (sum k_i nu_i) x alpha_last

   Both are one correction: attitude and velocity increment together are a rigid motion, whose logarithm is
   ``(phi, eta)``. Hence ``exp(phi)`` turns the body and ``J1(phi) eta`` is the velocity gained in the axes of
   the start, exactly so at constant rate and force;
4. quaternion by the body's rotation, then by the navigation frame's, then normalised;
5. velocity by the force, gravity and Coriolis taken in the middle of the interval, the force turned back by
   half the navigation frame's rotation;
6. position by turning ``b_ij``, the matrix from navigation to Earth axes, by the transport rate.

The navigation frame inside is horizontal, z down, and does not turn about the vertical (wander azimuth), so that
no formula divides by the cosine of the latitude; states are told in NED.

**The vertical channel needs aiding.** An error in height weakens gravity, which makes the height error grow: tenfold
in 22 minutes, without bound. Give an altitude, and a third-order loop holds height and vertical velocity; a run
without one is refused beyond :attr:`StrapdownParams.unaided_limit`.
"""

import math
from dataclasses import dataclass

import numpy as np

from inertial import _strapdown_kernels as kernels
from inertial.earth import SEMI_MAJOR_AXIS, STANDARD_GRAVITY
from inertial.imu_errors import Calibration
from inertial.parameters import check_parameters, parameter
from inertial.rotation import (
    dcm_from_quaternion,
    dcm_nb_from_euler,
    quaternion_exp,
    quaternion_multiply,
)


@dataclass(frozen=True)
class Scheme:
    """How increments are combined: the factors ``k_i`` before the last one, and how many are new."""

    k: tuple
    samples: int


SCHEMES = {
    "1+previous": Scheme((1 / 12,), 1),
    "2": Scheme((2 / 3,), 2),
    "2+previous": Scheme((-1 / 30, 11 / 15), 2),
    "3": Scheme((9 / 20, 27 / 20), 3),
    "4": Scheme((54 / 105, 92 / 105, 214 / 105), 4),
}
"""Name -> scheme; 3 and 4 samples are optimal for coning."""
NO_ERRORS = Calibration(np.zeros((3, 3)), np.zeros(3))


class VerticalChannelError(ValueError):
    """The vertical channel would be integrated alone for longer than it stays good."""


@dataclass(frozen=True)
class StrapdownParams:
    """How a strapdown navigator computes."""

    scheme: str = parameter(
        "2+previous", "", "Samples of a major interval, with the last one before it or not.",
        choices=tuple(SCHEMES))
    sample_interval: float = parameter(
        0.005, "s", "Time between IMU samples, hN1; a major interval hN3 is as many as the scheme takes.", 1e-5, 0.1)
    imu_semantics: str = parameter(
        "mean", "", "What a sample is: the mean over the interval that ends at its stamp, or the value at its stamp.",
        choices=("mean", "point"))
    altitude_time: float = parameter(
        30.0, "s", "Time constant at which the altitude holds the vertical channel; larger trusts the "
        "accelerometer longer.", 1.0, 300.0)
    unaided_limit: float = parameter(
        600.0, "s", "Longest time without an altitude.", 0.0, nan_means="no limit")

    def __post_init__(self):
        check_parameters(self)

    @property
    def major_interval(self):
        """The update interval hN3, s."""
        return SCHEMES[self.scheme].samples * self.sample_interval


@dataclass(frozen=True)
class NavigationState:
    """Where something is, how it moves and how it is turned; leading dimensions (...) are times.

    Attributes
    ----------
    latitude, longitude : (...), rad, geodetic
    height : (...), m, above the ellipsoid
    velocity_n : (..., 3), m/s, NED
    q_nb_wxyz : (..., 4)
        Body to NED.
    wander : (...), rad
        Heading of the navigator's own x axis; any start is as good.
    """

    latitude: np.ndarray
    longitude: np.ndarray
    height: np.ndarray
    velocity_n: np.ndarray
    q_nb_wxyz: np.ndarray
    wander: np.ndarray = 0.0


class Strapdown:
    """A strapdown navigator.

    Parameters
    ----------
    params : StrapdownParams
    start : NavigationState
        Of one time, without leading dimensions.
    gyro_calibration, accel_calibration : inertial.imu_errors.Calibration
        Errors to take out of the readings.

    Raises
    ------
    ValueError
        ``start`` is not one finite state.
    """

    def __init__(self, params, start, gyro_calibration=NO_ERRORS, accel_calibration=NO_ERRORS):
        scheme = SCHEMES[params.scheme]
        self.params = params
        self._new, self._k = scheme.samples, np.array(scheme.k)
        self._core = _pack(start)
        self._window = np.zeros((len(scheme.k) + 1, 6))
        self._history = np.zeros((3, 6))
        self._affine = np.stack([_affine(gyro_calibration), _affine(accel_calibration)])
        rate = 1 / params.altitude_time
        # The term 2 g / R makes up for gravity's gradient; the loop's three poles then are all at -rate.
        self._gains = np.array([3 * rate, 3 * rate**2 + 2 * STANDARD_GRAVITY / SEMI_MAJOR_AXIS, rate**3])
        self._unaided = 0.0

    @property
    def state(self):
        """The present :class:`NavigationState`."""
        return _unpack(self._core)

    def run(self, gyro_b, accel_b, altitude=None, every=1):
        """Navigate on; calls may follow each other and give what one call gives.

        Parameters
        ----------
        gyro_b, accel_b : (N * m, 3), rad/s and m/s^2
            All samples of N major intervals of m samples.
        altitude : (N,), optional, m
            Height above the ellipsoid at the end of each major interval; NaN where there is none.
        every : int
            Which states are returned.

        Returns
        -------
        NavigationState
            After major intervals ``every``, ``2 every``, ..., N.

        Raises
        ------
        ValueError
            Shapes that do not fit each other, or values that are not finite.
        VerticalChannelError
            No altitude for longer than ``unaided_limit``.
        """
        gyro_b, accel_b, altitude = self._checked(gyro_b, accel_b, altitude)
        if not 1 <= every <= len(altitude) or len(altitude) % every:
            raise ValueError(f"every = {every}: must divide the {len(altitude)} major intervals")
        self._watch_vertical(np.isnan(altitude))
        cores = kernels.run(self._core, self._window, self._history, gyro_b, accel_b, altitude, self._affine,
                            self.params.sample_interval, self.params.imu_semantics == "point", self._k,
                            self._new, self._gains, every)
        return _unpack(cores)

    def step(self, gyro_b, accel_b, altitude=math.nan):
        """Navigate on over one major interval and return the state; as :meth:`run` with N = 1."""
        self.run(gyro_b, accel_b, [altitude])
        return self.state

    def _checked(self, gyro_b, accel_b, altitude):
        gyro_b, accel_b = (np.ascontiguousarray(values, dtype=float) for values in (gyro_b, accel_b))
        count = len(gyro_b) // self._new
        for name, values in (("gyro_b", gyro_b), ("accel_b", accel_b)):
            if values.shape != (count * self._new, 3) or not count:
                raise ValueError(f"{name} has shape {values.shape}: must be ({self._new} N, 3), the same N for both")
            if not np.isfinite(values).all():
                raise ValueError(f"{name} is not finite")
        altitude = np.full(count, np.nan) if altitude is None else np.ascontiguousarray(altitude, dtype=float)
        if altitude.shape != (count,) or np.isinf(altitude).any():
            raise ValueError(f"altitude has shape {altitude.shape}: must be ({count},), m, NaN where there is none")
        return gyro_b, accel_b, altitude

    def _watch_vertical(self, unaided):
        """Refuse a gap in the altitudes that is too long, the one before this run included."""
        ends = np.flatnonzero(np.concatenate([[True], ~unaided, [True]]))
        gaps = (np.diff(ends) - 1) * self.params.major_interval
        gaps[0] += self._unaided
        if gaps.max() > self.params.unaided_limit:
            raise VerticalChannelError(
                f"{gaps.max():.0f} s without an altitude: the vertical channel is unstable and is not integrated "
                f"alone for more than unaided_limit = {self.params.unaided_limit:.0f} s")
        self._unaided = gaps[-1]


def combine_increments(dtheta_b, dvel_b, scheme, previous=None):
    """Return rotation vectors and velocity increments of major intervals, coning and sculling corrected.

    What :class:`Strapdown` does to its samples, for those who have the increments.

    Parameters
    ----------
    dtheta_b, dvel_b : (N * m, 3), rad and m/s
        Of the m samples of each interval.
    scheme : str
        A name in :data:`SCHEMES`.
    previous : (6,), optional
        Increments of angle and velocity before the first; by default the first ones again.

    Returns
    -------
    phi_b, dvel_b : (N, 3), rad and m/s
        The velocity gained is in the axes of the start of each interval.
    """
    k, new = np.array(SCHEMES[scheme].k), SCHEMES[scheme].samples
    increments = np.concatenate([dtheta_b, dvel_b], axis=1)
    before = len(k) + 1 - new
    increments = np.concatenate([[increments[0] if previous is None else previous] * before, increments]) \
        if before else increments
    vectors = [kernels.combine(increments[i:i + len(k) + 1], k, new)
               for i in range(0, len(increments) - len(k), new)]
    return (np.array([phi for phi, _ in vectors]),
            np.array([kernels.velocity_increment(phi, eta) for phi, eta in vectors]))


def dcm_en(latitude, longitude, wander=0.0):
    """Return the paper's b_ij, from navigation to Earth axes, (..., 3, 3).

    Earth axes: x to latitude and longitude 0, z to the north pole. Navigation axes: NED turned by ``wander``
    about down. All in rad.
    """
    # Euler's angles of NED in Earth axes: about z by the longitude, about y by what takes z from up the pole to down.
    return dcm_nb_from_euler(0.0, -np.asarray(latitude) - np.pi / 2, longitude) \
        @ dcm_nb_from_euler(0.0, 0.0, wander)


def _affine(calibration):
    """Return the (3, 4) matrix and offset that take the errors out of a reading."""
    matrix = np.linalg.inv(np.eye(3) + calibration.matrix)
    return np.column_stack([matrix, -matrix @ calibration.bias_b])


def _pack(state):
    turn = quaternion_exp([0.0, 0.0, -state.wander])
    core = np.concatenate([
        quaternion_multiply(turn, state.q_nb_wxyz), dcm_from_quaternion(turn) @ state.velocity_n,
        dcm_en(state.latitude, state.longitude, state.wander).ravel(), [state.height, 0.0]])
    if core.shape != (kernels.CORE_SIZE,) or not np.isfinite(core).all():
        raise ValueError(f"start = {state}: must be one finite state")
    core[:4] /= np.linalg.norm(core[:4])
    return core


def _unpack(core):
    b = core[..., kernels.B:kernels.B + 9].reshape(*core.shape[:-1], 3, 3)
    wander = np.arctan2(-b[..., 2, 1], b[..., 2, 0])
    turn = quaternion_exp(wander[..., None] * [0.0, 0.0, 1.0])
    return NavigationState(
        np.arctan2(-b[..., 2, 2], np.hypot(b[..., 2, 0], b[..., 2, 1])),
        np.arctan2(-b[..., 1, 2], -b[..., 0, 2]), core[..., kernels.HEIGHT].copy(),
        np.einsum("...ij,...j->...i", dcm_from_quaternion(turn), core[..., kernels.V:kernels.V + 3]),
        quaternion_multiply(turn, core[..., :4]), wander)
