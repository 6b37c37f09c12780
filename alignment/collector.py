"""Streams of IMU samples and joint angles to dwells, and to the samples of a table that keeps turning.

A stop begins where the table's angle stays within ``largest_angle_spread``; the first ``settle_time`` of it
is dropped, then every ``dwell_time`` makes a dwell. A table that has gone round once without a stop is
turning steadily, and its samples are handed out in blocks instead. Stamps are those of the messages: which stream
comes first does not matter.
"""

import dataclasses
import math
from collections import deque

import numpy as np

from alignment.dwells import reduce_dwell, rejected_dwell
from alignment.joint_check import JointCheck

FULL_TURN = 2 * math.pi
_LONGEST_GAP = 0.5  # s without a sample or an angle, after which a stop counts anew
_LONGEST_WAIT = 5.0  # s that one stream may be ahead of the other
_SHORTEST_SHARE = 0.5  # of dwell_time, from which a dwell that ends early counts
_BLOCK_SAMPLES, _BLOCK_TIME = 1000, 5.0  # of steady turning, s, that are handed out together


class DwellCollector:
    """Makes dwells of samples.

    Parameters
    ----------
    params : alignment.params.AlignmentParams

    Attributes
    ----------
    params : alignment.params.AlignmentParams
    wanted : float or None
        Table angle wanted next, rad. A table that stands at another one, where it has had its dwell, is
        waited for; with None every dwell counts.
    angle : float
        Last table angle, rad, NaN before the first.
    gaps, lost, refused : int
        Gaps in a stream; samples dropped because the other stream was missing; samples that were not numbers or not
        later than the one before.
    joint_check : alignment.joint_check.JointCheck
        Of all moves so far.
    """

    def __init__(self, params):
        self.params = params
        self.wanted = None
        self.gaps = self.lost = self.refused = 0
        self.reset()

    def reset(self):
        """Forget every sample, and when time began."""
        self._origin_ns = None
        self._dwelt_at = self._dwelt_until = math.nan
        self.joint_check = JointCheck()
        self.pause()

    def pause(self):
        """Forget every sample; dwells that follow come later than those before."""
        self._joints, self._waiting = deque(), deque()
        self._anchor = self._stop_start = self._last = self._newest = math.nan
        self._travel, self._dwelt = 0.0, True
        self._rows, self._moving, self._blocks = [], [], []
        self.angle = math.nan

    @property
    def still(self):
        """Whether the table stands and has settled."""
        return self._last - self._stop_start >= self.params.settle_time

    @property
    def turning(self):
        """Whether the table turns steadily."""
        return abs(self._travel) >= FULL_TURN

    @property
    def elapsed(self):
        """Length so far of the present dwell, s."""
        return self._rows[-1][0] - self._rows[0][0] if self._rows else 0.0

    def add_joint(self, stamp_ns, angle):
        """Take in the table's angle, rad; return the dwells that it completes.

        Angles that jump by whole turns (an encoder's wrap) are taken as the nearest.
        """
        time = self._time(stamp_ns) - self.params.joint_delay
        if self._joints:
            last, before = self._joints[-1]
            if time <= last:
                return []
            angle = before + math.remainder(angle - before, FULL_TURN)
        self._joints.append((time, angle))
        self.angle = angle
        if time - self._joints[0][0] > _LONGEST_WAIT and not self._waiting:
            self._joints.popleft()
        return self._serve()

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in an IMU sample; return the dwells that it completes."""
        time = self._time(stamp_ns)
        if time <= self._newest or not math.isfinite(sum(gyro_b) + sum(accel_b)):
            self.refused += 1
            return []
        self._newest = time
        self._waiting.append((time, *gyro_b, *accel_b))
        if time - self._waiting[0][0] > _LONGEST_WAIT:
            self._waiting.popleft()
            self.lost += 1
        return self._serve()

    def finish(self):
        """Return the dwell under way, in a list, if it is long enough to count, and end it."""
        return self._end_dwell()

    def partial(self):
        """Return the present dwell as far as it goes, or None."""
        return self._reduced(self._rows) if len(self._rows) > 1 else None

    def take_turning(self, last=False):
        """Return what has come of steady turning since the last call, in blocks.

        Parameters
        ----------
        last : bool
            Whether a block that is not full yet counts.

        Returns
        -------
        list of (N, 8) float64
            Time, s; table angle, rad; gyro_b, rad/s; accel_b, m/s^2.
        """
        if not self.turning:
            return []
        if last:
            self._end_block()
        blocks, self._blocks = self._blocks, []
        return blocks

    def _time(self, stamp_ns):
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        return (stamp_ns - self._origin_ns) * 1e-9

    def _serve(self):
        """Take every sample whose angle is known; a sample counts in the middle of its interval."""
        done = []
        joints = self._joints
        while self._waiting and len(joints) > 1 and joints[-1][0] >= self._waiting[0][0]:
            row = self._waiting.popleft()
            time = row[0]
            interval = time - self._last if time - self._last < _LONGEST_GAP else 0.0
            middle = time - 0.5 * interval
            while len(joints) > 2 and joints[1][0] < middle:
                joints.popleft()
            if middle < joints[0][0] or joints[1][0] - joints[0][0] > _LONGEST_GAP:
                self.lost += 1
                continue
            done += self._take(time, _interpolated(joints, middle), row[1:])
        return done

    def _take(self, time, angle, sample):
        done = []
        gap = not time - self._last < _LONGEST_GAP
        if gap:
            self.gaps += not math.isnan(self._last)
            done += self._end_dwell()
            self._end_move()
        moved = gap or not abs(angle - self._anchor) <= 0.5 * self.params.largest_angle_spread
        self._last = time
        if moved:
            done += self._end_dwell()
            if not gap:
                self._follow(angle - self._anchor)
                self._keep(time, angle, sample)
                self._dwelt = False
            self._anchor, self._stop_start = angle, time
        elif not self.still:
            if self._travel:
                self._keep(time, angle, sample)
        else:
            if self._travel and not self.turning:
                self._end_move()
            self._collect(time, angle, sample, done)
        return done

    def _collect(self, time, angle, sample, done):
        if self.wanted is not None and self._near(angle, self._dwelt_at) \
                and not self._near(angle, self.wanted):
            return
        self._rows.append((time, angle, *sample))
        if self.elapsed >= self.params.dwell_time:
            done.append(self._dwell())
            self._rows = []

    def _near(self, angle, other):
        return math.isfinite(other) \
            and abs(math.remainder(angle - other, FULL_TURN)) <= self.params.position_tolerance

    def _dwell(self):
        """Return the dwell of the present samples, which begins no earlier than the one before ended."""
        dwell = self._reduced(self._rows)
        start = dwell.start if math.isnan(self._dwelt_until) else max(dwell.start, self._dwelt_until)
        self._dwelt_at, self._dwelt_until, self._dwelt = dwell.angle, dwell.end, True
        return dataclasses.replace(dwell, start=start)

    def _follow(self, step):
        """Follow how far the table has gone since it last stood or turned back."""
        if not self.turning:
            if self._travel * step < 0:  # rocking to and fro is no turning
                self._end_move()
            self._travel += step

    def _keep(self, time, angle, sample):
        self._moving.append((time, angle, *sample))
        if len(self._moving) >= _BLOCK_SAMPLES or time - self._moving[0][0] >= _BLOCK_TIME:
            self._end_block()

    def _end_block(self):
        if self._moving:
            block = np.array(self._moving)
            self.joint_check.add(block[:, 0], block[:, 1], block[:, 4])
            self._blocks.append(block)
            self._moving = []

    def _end_move(self):
        """Forget a mere move but for what it tells of the joint; what was steady turning stays to be taken."""
        self._end_block()
        self.joint_check.end_move()
        if not self.turning:
            self._travel, self._blocks = 0.0, []

    def _end_dwell(self):
        done, shortest = [], _SHORTEST_SHARE * self.params.dwell_time
        if self._rows and self.elapsed >= shortest:
            done.append(self._dwell())
        elif self._rows and not self._dwelt and not self.turning:
            done.append(rejected_dwell(*columns_of(np.array(self._rows))[:2],
                                       f"stood only {self.elapsed:.1f} s after settling; half of dwell_time, "
                                       f"{shortest:g} s, is the least"))
        self._rows = []
        return done

    def _reduced(self, rows):
        rows = np.array(rows)
        return reduce_dwell(*columns_of(rows), self.params)


def columns_of(rows):
    """Return times (N,), table angles (N,), gyro_b and accel_b (N, 3) of rows (N, 8)."""
    return rows[:, 0], rows[:, 1], rows[:, 2:5], rows[:, 5:8]


def _interpolated(joints, time):
    (start, before), (end, after) = joints[0], joints[1]
    return before + (after - before) * (time - start) / (end - start)
