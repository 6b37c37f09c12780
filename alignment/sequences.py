"""Which table angle when: schedules of a turntable.

A table angle is ``tau`` of :mod:`alignment.turntable`, rad, positive clockwise seen from above (about z
down). Times are seconds since the start.
"""

from dataclasses import dataclass

import numpy as np

FOUR_POSITIONS = (0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi)
# Any error that grows evenly in time is the same in sum at each angle, so that it cancels.
PALINDROME = FOUR_POSITIONS + FOUR_POSITIONS[::-1]
COARSE_SHARE = 0.25


@dataclass(frozen=True)
class Schedule:
    """Intervals of readings and where the table is in each.

    Attributes
    ----------
    angle : (K,) float64, rad
        Table angle in the middle of each interval.
    start, end : (K,) float64, s
    rate : (K,) float64, rad/s
        Turning rate of the table; zero when it is indexed.
    """

    angle: np.ndarray
    start: np.ndarray
    end: np.ndarray
    rate: np.ndarray

    @property
    def middle(self):
        """Middle of each interval, s."""
        return 0.5 * (self.start + self.end)

    @property
    def duration(self):
        """Length of each interval, s."""
        return self.end - self.start


def indexed_schedule(angles, dwell_time, settle_time=0.0, start=0.0):
    """Return the schedule of a table that steps through the angles.

    Parameters
    ----------
    angles : (K,) rad
    dwell_time : float or (K,), s
        Used time at each angle.
    settle_time : float, s
        Unused time before each dwell, while the table turns and comes to rest.
    start : float, s
    """
    angles = np.asarray(angles, dtype=float)
    dwell_time = np.broadcast_to(np.asarray(dwell_time, dtype=float), angles.shape)
    end = start + np.cumsum(dwell_time + settle_time)
    return Schedule(angles, end - dwell_time, end, np.zeros_like(angles))


def single_pass(total_time):
    """Return the textbook schedule: 0, 90, 180 and 270 deg, once."""
    return indexed_schedule(FOUR_POSITIONS, total_time / 4)


def palindrome(total_time, dwell_time=15.0, settle_time=0.0):
    """Return 0-90-180-270-270-180-90-0 deg, repeated.

    Parameters
    ----------
    total_time : float, s
        Filled by whole rounds.
    dwell_time : float, s
        At most; less where whole rounds want it.
    settle_time : float, s
    """
    return _rounds(PALINDROME, total_time, dwell_time, settle_time, 0.0)


def refinement(best_angle, total_time, dwell_time=15.0, settle_time=0.0, start=0.0):
    """Return the two angles that tell the heading best, east and west of a level table, in turn.

    The order is +--+ so that a drift cancels.

    Parameters
    ----------
    best_angle : float, rad
        From :func:`alignment.bounds.best_angle`.
    total_time, dwell_time, settle_time, start : float, s
        As in :func:`palindrome`.
    """
    opposite = best_angle + np.pi
    return _rounds((best_angle, opposite, opposite, best_angle), total_time, dwell_time, settle_time, start)


def _rounds(angles, total_time, dwell_time, settle_time, start):
    # The slack keeps a time that is a whole number of rounds from becoming one more.
    rounds = max(1, int(np.ceil(total_time / (len(angles) * (dwell_time + settle_time)) - 1e-9)))
    dwell_time = total_time / (len(angles) * rounds) - settle_time
    return indexed_schedule(angles * rounds, dwell_time, settle_time, start)


def continuous_rotation(rate, total_time, sample_interval, both_ways=True):
    """Return the schedule of a table that turns steadily, the second half the other way.

    Errors of the table that follow its rate, such as wobble, change sign with it and cancel.

    Parameters
    ----------
    rate : float, rad/s
    total_time, sample_interval : float, s
    both_ways : bool
    """
    count = round(total_time / sample_interval)
    start = sample_interval * np.arange(count)
    middle = start + 0.5 * sample_interval
    turned = 0.5 * total_time
    back = both_ways & (middle > turned)
    angle = rate * np.where(back, 2 * turned - middle, middle)
    return Schedule(angle, start, start + sample_interval, np.where(back, -rate, rate))


def joined(*schedules):
    """Return the schedules as one."""
    return Schedule(*(np.concatenate([getattr(part, name) for part in schedules])
                      for name in ("angle", "start", "end", "rate")))
