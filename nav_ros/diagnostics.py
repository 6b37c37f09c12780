"""What a node says about itself: counters, values and faults, rates and latencies.

Nothing here reads a clock; times are passed in. A report starts empty each time it is made, so a fault that
has gone is gone from the next one, and the worst level among its faults is that of the report.
"""

import enum
import math
from collections import deque

SILENT_PERIODS = 5
"""Periods of a topic without a message after which it may have stopped."""


class Level(enum.IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Report:
    """One status in the making.

    Parameters
    ----------
    name : str
        What reports, for example ``"attitude_node: imu"``.
    hardware_id : str
    """

    def __init__(self, name, hardware_id=""):
        self.name = name
        self.hardware_id = hardware_id
        self._faults = []
        self._values = {}

    def fault(self, level, text):
        """Add a fault; the worst one's level becomes that of the report."""
        self._faults.append((Level(level), text))

    def value(self, key, value):
        """Add a value; numbers are written with six digits, unknown ones (NaN) as ``unknown``."""
        self._values[key] = _text(value)

    def counters(self, counters):
        """Add a dict of counters, name -> count."""
        for name, count in counters.items():
            self._values[name] = str(count)

    @property
    def level(self):
        """The worst level so far."""
        return max((level for level, _ in self._faults), default=Level.OK)

    @property
    def message(self):
        """The faults from the worst down, or ``OK``."""
        worst_first = sorted(self._faults, key=lambda fault: -fault[0])
        return "; ".join(text for _, text in worst_first) or "OK"

    @property
    def values(self):
        """Key -> text."""
        return dict(self._values)


def diagnostic_array(stamp_ns, reports):
    """Return a diagnostic_msgs/DiagnosticArray of several :class:`Report`.

    Parameters
    ----------
    stamp_ns : int
        The node's time.
    reports : iterable of Report
    """
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    array = DiagnosticArray()
    array.header.stamp.sec, array.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    for report in reports:
        array.status.append(DiagnosticStatus(
            level=bytes([report.level]), name=report.name, message=report.message,
            hardware_id=report.hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in report.values.items()]))
    return array


class StreamMeter:
    """Rate and latency of one topic over its last messages.

    Parameters
    ----------
    window : int
        How many messages are remembered; memory does not grow beyond it.
    patience : float
        Seconds without a message, or :data:`SILENT_PERIODS` of the topic, after which it has stopped.
    """

    def __init__(self, window=1000, patience=math.inf):
        self._times = deque(maxlen=window)
        self._patience = patience

    def add(self, stamp_ns, arrival_ns):
        """Remember one message.

        Parameters
        ----------
        stamp_ns, arrival_ns : int
            The message's own stamp, and the node's time when it came.
        """
        self._times.append((stamp_ns, arrival_ns))

    @property
    def stamp_rate(self):
        """Hz by the messages' stamps, NaN while unknown."""
        return self._rate(0)

    @property
    def arrival_rate(self):
        """Hz by the times of arrival, NaN while unknown."""
        return self._rate(1)

    def latency(self, share):
        """Return the seconds of latency that `share` (0 to 1) of the messages stay within, NaN if unknown."""
        latencies = sorted(arrival - stamp for stamp, arrival in self._times)
        if not latencies:
            return math.nan
        return latencies[min(int(share * len(latencies)), len(latencies) - 1)] * 1e-9

    def age(self, now_ns):
        """Return the seconds since the last arrival, NaN before the first."""
        return (now_ns - self._times[-1][1]) * 1e-9 if self._times else math.nan

    def silence(self, now_ns):
        """Return the seconds since the last arrival if the topic has stopped, otherwise 0."""
        age, rate = self.age(now_ns), self.stamp_rate
        limit = self._patience if math.isnan(rate) else max(self._patience, SILENT_PERIODS / rate)
        return age if age > limit else 0.0

    def _rate(self, which):
        if len(self._times) < 2:
            return math.nan
        span = self._times[-1][which] - self._times[0][which]
        return (len(self._times) - 1) * 1e9 / span if span > 0 else math.nan


def _text(value):
    if isinstance(value, float):
        return "unknown" if math.isnan(value) else f"{value:.6g}"
    return str(value).lower() if isinstance(value, bool) else str(value)
