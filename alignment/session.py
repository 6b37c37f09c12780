"""An alignment on a turntable from streams of samples: what ``alignment_node`` and ``align_bag`` run.

It joins :class:`alignment.collector.DwellCollector`, :class:`alignment.station.TableAlignment` and
:func:`alignment.station.align_turning`, chooses the method, and says why there is no heading when there is
none.
"""

import dataclasses
import math

import numpy as np

from alignment.collector import DwellCollector
from alignment.dwells import Dwell
from alignment.errors import NotEnoughDataError
from alignment.north import explain_scale
from alignment.results import SINGULAR_SENSITIVITY, UNBELIEVABLE, Quality
from alignment.sequences import FOUR_POSITIONS
from alignment.station import TableAlignment, align_turning
from alignment.turntable import Turntable, exact_readings

_REFRESH = 5.0  # s of turning, or this share of it, after which it is solved anew
_REFRESH_SHARE = 0.1
_PREVIEW = 1.0  # s of standing from which a first level is given
_FEWEST_ANGLES = 3
_NO_LATITUDE = "the latitude is not known: level only"


class TableSession:
    """Level and heading of a turntable from its angle and an IMU, sample by sample.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    follow : bool
        Whether a table that stands where it has had its dwell is waited for until it turns to the wanted
        angle; otherwise every dwell counts, as of a recording.

    Attributes
    ----------
    result : alignment.station.AlignmentResult or None
        None until the first second at rest; later of the parameters' method.
    running : bool
        While it is false samples are ignored.
    """

    def __init__(self, params, follow=True):
        self._follow = follow
        self._station = TableAlignment(params)
        self._collector = DwellCollector(params)
        self.running = True
        self._remarks = []
        self.params = params
        self.reset()

    @property
    def params(self):
        """Parameters; the result changes with them."""
        return self._params

    @params.setter
    def params(self, params):
        self._params = params
        near_pole = math.cos(params.latitude) < SINGULAR_SENSITIVITY
        self._no_latitude = ""
        if near_pole:
            self._no_latitude = (f"latitude {math.degrees(params.latitude):.3f} deg is too near a pole for a "
                                 "heading: level only")
        elif math.isnan(params.latitude):
            self._no_latitude = _NO_LATITUDE
        used = dataclasses.replace(params, latitude=math.nan) if near_pole else params
        self._station.params = self._collector.params = used
        self._turned = None
        self._turned_time = 0.0
        if self._station.dwells:
            self._solve()

    def reset(self):
        """Forget everything that was measured."""
        self._station.reset()
        self._collector.reset()
        self.result, self._turned, self._turned_time = None, None, 0.0
        self._missing = ""
        self.wanted = self._next_angle()

    def stop(self):
        """Take in the dwell under way, if it is long enough, and ignore what comes until :meth:`start`."""
        changed = self.finish()
        self.running = False
        self._collector.pause()
        self._turned_time = 0.0
        return changed

    def start(self):
        """Take in samples."""
        self.running = True

    def finish(self):
        """Take in the dwell under way and the last turning; return whether the result has changed."""
        return self._add(self._collector.finish()) | self._turn(last=True)

    def add_joint(self, stamp_ns, angle):
        """Take in the table's angle, rad; return whether the result has changed."""
        return self.running and self._add(self._collector.add_joint(stamp_ns, angle))

    def add_imu(self, stamp_ns, gyro_b, accel_b):
        """Take in a sample, rad/s and m/s^2; return whether the result has changed."""
        if not self.running:
            return False
        changed = self._add(self._collector.add_imu(stamp_ns, gyro_b, accel_b))
        return changed | self._turn() | self._preview()

    def take_remarks(self):
        """Return what has been accepted and rejected since the last call, each as (good, text)."""
        remarks, self._remarks = self._remarks, []
        return remarks

    @property
    def dwells(self):
        """The accepted dwells."""
        return self._station.dwells

    @property
    def rejected(self):
        """The rejected dwells."""
        return tuple(self._station.rejected)

    @property
    def turning(self):
        """Whether the result is that of a table that turns steadily."""
        return self._turned is not None and self.result is self._turned

    @property
    def table_angle(self):
        """Last table angle, rad, NaN before the first."""
        return self._collector.angle

    @property
    def lost(self):
        """Samples without an angle, or angles without samples."""
        return self._collector.lost

    @property
    def gaps(self):
        """Gaps in the samples."""
        return self._collector.gaps

    @property
    def phase(self):
        """One of stopped, waiting, coarse, positions, rotation, aligned."""
        if not self.running:
            return "stopped"
        if self.result is None:
            return "waiting"
        if self.result.north is None:
            return "coarse"
        if not self.refusal and self.result.north.std <= self.params.target_std:
            return "aligned"
        return "rotation" if self.turning else "positions"

    @property
    def activity(self):
        """What the table and the sensors are doing, in words."""
        collector = self._collector
        if math.isnan(collector.angle):
            return "no angle of the table yet"
        if collector.elapsed:
            return f"dwell of {collector.elapsed:.1f} s, {self.params.dwell_time:g} s wanted"
        if not collector.still:
            return "the table turns or has not settled"
        return f"waits for table angle {math.degrees(self.wanted):.2f} deg, clockwise"

    @property
    def refusal(self):
        """Why there is no heading, or why it must not be believed; empty when it may be."""
        if self.result is None:
            return "the table has not stood still yet"
        level, north = self.result.level, self.result.north
        if level.flags & Quality.SCALE:
            return f"the accelerometers read {explain_scale(float(level.scale))}"
        if self._no_latitude:
            return self._no_latitude
        if north is None:
            return self._missing or self._too_few
        return "; ".join(text for flag, text in _REASONS.items() if north.flags & flag & UNBELIEVABLE).format(
            scale=explain_scale(float(north.scale)) if np.isfinite(north.scale) else "",
            other=math.degrees(float(north.branches[1])) if len(north.branches) > 1 else math.nan,
            chi2=float(north.chi2))

    @property
    def _too_few(self):
        if len(self.dwells) < _FEWEST_ANGLES:
            return f"{len(self.dwells)} of at least {_FEWEST_ANGLES} table angles so far"
        return self.result.reason

    def compare(self):
        """Return levels and headings by every method that the dwells serve: two dicts, name to result.

        Raises
        ------
        NotEnoughDataError
            No dwell yet.
        """
        levels = self._station.compare_levelling()
        headings = {} if self._no_latitude else self._station.compare_methods(
            level=levels.get(self.params.levelling))
        return levels, headings

    def _add(self, dwells):
        for dwell in dwells:
            reason = self._station.add(dwell)
            where = f"at {math.degrees(dwell.angle) % 360:.2f} deg"
            self._remarks.append((not reason, f"dwell {where} rejected: {reason}" if reason else
                                  f"dwell {len(self.dwells)} {where}: {dwell.duration:.1f} s, "
                                  f"{dwell.kept:.1%} of the samples"))
            self.wanted = self._next_angle()
        if not dwells or not self.dwells:
            return False
        self._solve()
        return True

    def _next_angle(self):
        wanted = self._station.next_angle()
        self._collector.wanted = wanted if self._follow else None
        return wanted

    def _preview(self):
        """Give the level of the first seconds; a later dwell is better."""
        if self.result is not None or self._collector.elapsed < _PREVIEW:
            return False
        first = TableAlignment(self._station.params)
        if first.add(self._collector.partial()):
            return False
        self.result = first.result()
        self._missing = "the first dwell is under way"
        return True

    def _turn(self, last=False):
        """Solve the steady turning again when there is enough more of it."""
        time = self._collector.turned_time
        wanted = self._turned_time + (0.0 if last else max(_REFRESH, _REFRESH_SHARE * self._turned_time))
        if not time > wanted:
            return False
        self._turned_time = time
        try:
            self._turned = align_turning(*self._collector.turning_samples(), self._station.params)
        except NotEnoughDataError:
            return False
        self._choose()
        return True

    def _solve(self):
        self.result, self._missing = self._by_method(self._station.result())
        self._choose()

    def _choose(self):
        """Take the steady turning's result where it is the better one."""
        turned = self._turned
        if turned is None or (turned.north is None and self.dwells):
            return
        rival = self.result.north if self.result is not None else None
        if rival is None or not rival.std <= turned.north.std:
            self.result, self._missing = turned, ""

    def _by_method(self, found):
        """Return the result with level and heading by the parameters' methods, and what these lack."""
        method, levelling = self.params.method, self.params.levelling
        if method == levelling == "joint" or found.north is None:
            return found, ""
        levels, headings = self.compare()
        lacking = [name for name, there in ((levelling, levels), (method, headings)) if name not in there]
        if lacking:
            missing = f"{lacking[0]} lacks a position: the sequence goes on"
            return dataclasses.replace(found, north=None), missing
        north = headings[method]
        time_left = 0.0 if north.std <= self.params.target_std else math.nan
        if method == "joint":
            north, time_left = found.north, found.time_left
        return dataclasses.replace(found, level=levels[levelling], north=north, time_left=time_left), ""


def warm_up(params):
    """Solve a made-up alignment once, so that no later one waits for a compiler.

    Parameters
    ----------
    params : alignment.params.AlignmentParams
    """
    station = TableAlignment(dataclasses.replace(params, latitude=0.5))
    readings = exact_readings(Turntable(latitude=0.5, heading=1.0), np.array(FOUR_POSITIONS))
    for k, angle in enumerate(FOUR_POSITIONS):
        station.add(Dwell(angle, float(k), k + 1.0, readings.gyro_b[k], readings.accel_b[k]))
    station.result()


_REASONS = {
    Quality.SINGULAR: "this geometry carries no information about the heading",
    Quality.AMBIGUOUS: "another heading fits as well ({other:.1f} deg): go on",
    Quality.SCALE: "the gyros read {scale}",
    Quality.INCONSISTENT: "the readings scatter more than their noise and priors allow (chi2 {chi2:.3g})",
}
