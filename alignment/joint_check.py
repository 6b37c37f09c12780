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
_DELAY_STD = 2e-3  # s, from which a delay is known
_FEWEST = 20  # samples of a move
_TURN = 1.0  # rad, of which a long move is cut into parts; gyro biases matter little beside it
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
            return (f"the joint's stamps are {1e3 * abs(self.delay):.0f} ms {way}, which turns the heading of a table "
                    f"that turns steadily: set joint_delay to {self.delay:.3f}")
        return ""


class JointCheck:
    """Sums over the moves of a table."""

    def __init__(self):
        self._normal, self._moment, self._square, self._count = np.zeros((2, 2)), np.zeros(2), 0.0, 0
        self._move = []

    def add(self, time, angle, gyro_z):
        """Take in samples of a move that follow those before without a gap.

        Parameters
        ----------
        time : (N,) float64, s
            Ends of the samples' intervals.
        angle : (N,) float64, rad
            Table angle in the middle of each interval.
        gyro_z : (N,) float64, rad/s
            Mean over each interval, about z, down.
        """
        self._move.append(np.stack([time, angle, gyro_z]))
        if abs(angle[-1] - self._move[0][1, 0]) > _TURN:
            self.end_move()

    def end_move(self):
        """Sum up the move so far; what follows is another."""
        if not self._move:
            return
        time, angle, gyro_z = np.concatenate(self._move, axis=1)
        self._move = []
        if len(time) < _FEWEST or np.ptp(angle) < 0.5 * _TURN:
            return
        interval = np.diff(time, prepend=2 * time[0] - time[1])
        turned = np.cumsum(gyro_z * interval) - 0.5 * gyro_z * interval
        columns = np.stack([turned, -gyro_z])
        columns -= columns.mean(axis=1, keepdims=True)
        angle = angle - angle.mean()
        self._normal += columns @ columns.T
        self._moment += columns @ angle
        self._square += angle @ angle
        self._count += len(angle)

    def verdict(self):
        """Return the :class:`JointVerdict` so far."""
        turned, cross, rate = self._normal[0, 0], self._normal[0, 1], self._normal[1, 1]
        if not turned > 0:
            return JointVerdict()
        ratio, delay = float(self._moment[0] / turned), math.nan
        residual = self._residual(ratio * self._moment[0])
        # What the rate's changes add to a constant rate, which cannot tell a delay.
        change = rate - cross ** 2 / turned
        if change > 0:
            found = np.linalg.solve(self._normal, self._moment)
            with_delay = self._residual(found @ self._moment)
            if with_delay < _DELAY_STD * abs(found[0]) * math.sqrt(change):
                ratio, delay, residual = float(found[0]), float(found[1] / found[0]), with_delay
        return JointVerdict(ratio, delay, _error(ratio, residual / math.sqrt(self._square / self._count)))

    def _residual(self, explained):
        return math.sqrt(max(self._square - explained, 0.0) / self._count)


def _error(ratio, residual):
    if abs(ratio - 1) < _LARGEST_RATIO_ERROR and residual < _LARGEST_RESIDUAL:
        return ""
    told = f"the joint turns by {ratio:.3g} times what the z gyro feels"
    for factor, reason in ((-1.0, "its positive direction must be counter-clockwise seen from above"),
                           (_DEGREE, "is it in deg, not rad?"), (1 / _DEGREE, "is the gyro in deg/s, not rad/s?"),
                           (-_DEGREE, "is it in deg, not rad, and clockwise?")):
        if abs(ratio / factor - 1) < _LARGEST_RATIO_ERROR:
            return f"{told}: {reason}"
    return f"{told}: is it the table's joint, is it in rad, and is the IMU's z axis along the table's?"
