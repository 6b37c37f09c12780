"""Whether the table's joint turns as the z gyro feels it turn: sign, unit and delay of the joint.

While the table moves, ``angle(t) = constant + ratio turned(t - delay)`` with ``turned`` the integral of the z gyro.
To first order that is linear in ``ratio`` and ``ratio delay``; the sums over all moves give both. What speeds
up and slows down tells the delay, a steady rotation alone does not.
"""

import math
from dataclasses import dataclass

import numpy as np

_LARGEST_RATIO_ERROR = 0.05  # more than any scale factor
_LARGEST_DELAY = 0.02  # s, told beyond
_FEWEST = 20  # samples of a move
_SMALLEST_TURN = 0.3  # rad, RMS over a move: gyro biases matter little beside it
_SMALLEST_CHANGE = 0.02  # rad/s, RMS change of the rate: enough to see a delay
_LARGEST_RESIDUAL = 0.05  # of the turn: the joint follows the gyro
_DEGREE = math.degrees(1.0)


@dataclass(frozen=True)
class JointVerdict:
    """What the moves tell.

    Attributes
    ----------
    ratio : float
        Turn of the joint per turn felt by the z gyro; NaN before a move.
    delay : float, s
        By how much the joint's stamps are late against the IMU's; NaN where it cannot be told.
    error : str
        Why no heading may be believed; empty where there is no reason.
    """

    ratio: float = math.nan
    delay: float = math.nan
    error: str = ""

    @property
    def warning(self):
        """What else should be told, or an empty string."""
        if abs(self.delay) > _LARGEST_DELAY:
            way = "late" if self.delay > 0 else "early"
            return (f"the joint's stamps are {1e3 * abs(self.delay):.0f} ms {way}: set joint_delay to "
                    f"{self.delay:.3f}, or turn the table both ways")
        return ""


class JointCheck:
    """Sums over the moves of a table."""

    def __init__(self):
        self._normal, self._moment, self._square, self._count = np.zeros((2, 2)), np.zeros(2), 0.0, 0

    def add(self, time, angle, gyro_z):
        """Take in a move, or a part of a long one: samples without a gap.

        Parameters
        ----------
        time : (N,) float64, s
            Ends of the samples' intervals.
        angle : (N,) float64, rad
            Table angle in the middle of each interval.
        gyro_z : (N,) float64, rad/s
            Mean over each interval, about z, down.
        """
        if len(time) < _FEWEST:
            return
        interval = np.diff(time, prepend=2 * time[0] - time[1])
        turned = np.cumsum(gyro_z * interval) - 0.5 * gyro_z * interval
        columns = np.stack([turned, -gyro_z])
        columns -= columns.mean(axis=1, keepdims=True)
        angle = angle - angle.mean()
        if turned.std() > _SMALLEST_TURN:
            self._normal += columns @ columns.T
            self._moment += columns @ angle
            self._square += angle @ angle
            self._count += len(angle)

    def verdict(self):
        """Return the :class:`JointVerdict` so far."""
        if not self._count:
            return JointVerdict()
        turn, change = np.sqrt(np.diag(self._normal) / self._count)
        delay = math.nan
        if change > _SMALLEST_CHANGE:
            found = np.linalg.solve(self._normal, self._moment)
            ratio, delay = float(found[0]), float(found[1] / found[0])
            fitted = float(found @ self._moment)
        else:
            ratio = float(self._moment[0] / self._normal[0, 0])
            fitted = ratio * float(self._moment[0])
        residual = math.sqrt(max(self._square - fitted, 0.0) / self._count)
        return JointVerdict(ratio, delay, _error(ratio, residual / (abs(ratio) * turn)))


def _error(ratio, residual):
    if abs(ratio - 1) < _LARGEST_RATIO_ERROR and residual < _LARGEST_RESIDUAL:
        return ""
    told = f"the joint turns by {ratio:.3g} times what the z gyro feels"
    for factor, reason in ((-1.0, "its positive direction must be counter-clockwise seen from above"),
                           (_DEGREE, "is it in deg, not rad?"), (1 / _DEGREE, "is the gyro in deg/s, not rad/s?"),
                           (-_DEGREE, "is it in deg, not rad, and clockwise?")):
        if abs(ratio / factor - 1) < _LARGEST_RATIO_ERROR:
            return f"{told}: {reason}"
    return f"{told}: wrong joint, or is the IMU's z axis not along the table's?"
