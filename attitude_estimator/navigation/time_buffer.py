"""Measurements at their stamps: the last second of samples and states, to go back to and step over again."""

from bisect import bisect_right

import numpy as np

HISTORY = 1024
"""Samples that can be taken back."""
SNAPSHOTS = 16
"""The state after every so many samples is kept."""
AHEAD_LIMIT_NS = 1_000_000_000
"""How far a measurement may be ahead of the samples."""


class TimeBuffer:
    """Steps a filter over samples and measurements in the order of their stamps, however they arrive.

    Parameters
    ----------
    state : (S,) float64 array
        Of the filter; kept and put back as a whole.
    row_size : int
        Of a sample's row.
    carry : callable
        ``carry(row)`` steps the state over a sample.
    take : callable
        ``take(measurement, age, row)`` takes a measurement valid `age` s before the sample of that row.
    """

    def __init__(self, state, row_size, carry, take):
        self._state, self._carry, self._take = state, carry, take
        self._rows = np.zeros((HISTORY, row_size))
        self._kept = np.zeros((HISTORY // SNAPSHOTS, len(state)))
        self._stamps = np.zeros(HISTORY, np.int64)
        self.clear()

    def clear(self):
        """Forget samples and measurements."""
        self._count = 0  # of samples since the beginning, the first one without a row
        self._queue, self._queue_stamps = [], []
        self._next = 0  # of the queue: what is not taken yet
        self.last_ns = 0

    def __len__(self):
        return min(self._count, HISTORY)

    def begin(self, stamp_ns):
        """Forget the past of this stamp; measurements that wait for later samples stay."""
        waiting = slice(self._next, None)
        self._queue, self._queue_stamps, self._next = self._queue[waiting], self._queue_stamps[waiting], 0
        self._count, self._stamps[0], self.last_ns = 1, stamp_ns, stamp_ns
        self._kept[0] = self._state

    @property
    def next_row(self):
        """The row to fill for the sample that :meth:`add` then takes."""
        return self._rows[self._count % HISTORY]

    def add(self, stamp_ns):
        """Step over the sample in :attr:`next_row`, then take the measurements up to its stamp."""
        at = self._count
        self._count += 1
        self._stamps[at % HISTORY] = self.last_ns = stamp_ns
        self._advance(at)

    def insert(self, stamp_ns, measurement, buffer_ns):
        """Take a measurement where it belongs in time.

        Parameters
        ----------
        stamp_ns : int
        measurement : tuple
            Its first element tells its kind; one of each kind has a stamp to itself.
        buffer_ns : int
            How late it may be.

        Returns
        -------
        str
            Empty where it counts, otherwise "late", "ahead" or "duplicate".
        """
        if stamp_ns > self.last_ns + AHEAD_LIMIT_NS:
            return "ahead"
        place = bisect_right(self._queue_stamps, stamp_ns)
        k = place - 1
        while k >= 0 and self._queue_stamps[k] == stamp_ns:
            if self._queue[k][0] == measurement[0]:
                return "duplicate"
            k -= 1
        back = self._samples_since(stamp_ns)
        newest = back == 1 and self._count > 1 and place == self._next == len(self._queue)
        origin = self._count - 1 - back
        if back and not newest:
            origin -= origin % SNAPSHOTS
            if origin < max(self._count - HISTORY, 0) or self.last_ns - stamp_ns > buffer_ns:
                return "late"
        self._queue.insert(place, measurement)
        self._queue_stamps.insert(place, stamp_ns)
        if newest:
            # Since the sample before, and the last of all: what going back would come to.
            self._take_due(self._count - 1)
        elif back:
            self._go_back(origin)
        self._forget_old()
        return ""

    def _samples_since(self, stamp_ns):
        """How many remembered samples are at or after the stamp."""
        back = 0
        while back < len(self) and self._stamps[(self._count - 1 - back) % HISTORY] >= stamp_ns:
            back += 1
        return back

    def _advance(self, at):
        self._carry(self._rows[at % HISTORY])
        self._take_due(at)

    def _take_due(self, at):
        stamp_ns, row = self._stamps[at % HISTORY], self._rows[at % HISTORY]
        while self._next < len(self._queue) and self._queue_stamps[self._next] <= stamp_ns:
            self._take(self._queue[self._next], (stamp_ns - self._queue_stamps[self._next]) * 1e-9, row)
            self._next += 1
        if at % SNAPSHOTS == 0:
            self._kept[at % HISTORY // SNAPSHOTS] = self._state

    def _go_back(self, origin):
        self._state[:] = self._kept[origin % HISTORY // SNAPSHOTS]
        self._next = bisect_right(self._queue_stamps, self._stamps[origin % HISTORY])
        for at in range(origin + 1, self._count):
            self._advance(at)

    def _forget_old(self):
        """Drop measurements that no step back can come to."""
        oldest = self._stamps[max(self._count - HISTORY, 0) % HISTORY]
        done = min(bisect_right(self._queue_stamps, oldest), self._next)
        del self._queue[:done], self._queue_stamps[:done]
        self._next -= done
