"""What the values of an IMU's messages show of a wrong unit, a wrong side up, an unusable covariance.

The readings are averaged over quarters of a second, which costs little at any rate. Turning and gravity are
compared there: while the force is of gravity's size, its direction must turn as the gyro says.
Values are those of the messages (FLU, rad/s, m/s^2).
"""

import math
from collections import deque

GRAVITY = 9.80665

_WINDOW_NS = 250_000_000
_GRAVITY_SHARE = 0.05  # how far a force may be off gravity's size and still show its direction
# rad/s across gravity. A multirotor's force keeps to its thrust, an aircraft's in a turn to its lift, so slow turns
# say nothing against the gyro; faster ones do not last with a force of gravity's size.
_TURN, _FAST_TURN = 0.3, 3.0
_DISAGREE, _AGREE = 0.2, 0.5  # share of the gyro's turn that gravity makes: below it does not, above it does
_STEADY = 4  # windows with nearly the same force, after which it counts as standing
_STANDING_RATE = 0.1  # rad/s: a steady turn has a steady force, too
_VERDICT = 20  # windows that disagree, each that agrees taking three away
_UPSIDE_DOWN = -0.7  # cosine of the angle between the vehicle's up and the force
_SIZE_WINDOWS = 20  # over which the size of the force is averaged
# Size of the force on average, whatever the motion -> unit.
_FORCE_UNITS = ((0.8, 1.25, "g", "9.80665"), (800.0, 1250.0, "milli-g or cm/s^2", "0.00980665 or 0.01"),
                (8000.0, 12500.0, "mm/s^2", "0.001"))


class ImuCheck:
    """Looks over the samples of one IMU.

    Parameters
    ----------
    up_imu : (3,) sequence
        The vehicle's up direction in the axes of the IMU, for an IMU that is not mounted level.
    """

    def __init__(self, up_imu=(0.0, 0.0, 1.0)):
        self.up_imu = up_imu
        self._begin(0)
        self._last = None
        self._steady = 0
        self._disagreeing = 0
        self._upside_down = False
        self._sizes = deque(maxlen=_SIZE_WINDOWS)

    def add(self, stamp_ns, gyro, accel):
        """Take a sample: two sequences of three floats."""
        if stamp_ns - self._start_ns >= _WINDOW_NS or stamp_ns < self._start_ns:
            if self._count and 0 < stamp_ns - self._start_ns < 2 * _WINDOW_NS:
                self._judge((stamp_ns - self._start_ns) * 1e-9)
            self._begin(stamp_ns)
        self._count += 1
        sums = self._sums
        sums[0] += gyro[0]
        sums[1] += gyro[1]
        sums[2] += gyro[2]
        sums[3] += accel[0]
        sums[4] += accel[1]
        sums[5] += accel[2]

    @property
    def standing(self):
        """Whether the last second shows neither turning nor a change of the force."""
        return self._steady >= _STEADY

    @property
    def faults(self):
        """What is wrong now, as a dict of counter name -> text."""
        faults = {}
        size = sum(self._sizes) / _SIZE_WINDOWS if len(self._sizes) == _SIZE_WINDOWS else math.nan
        for least, most, unit, factor in _FORCE_UNITS:
            if least < size < most:
                faults["accel_unit"] = (f"the force is {size:.3g} on average: it looks like {unit}, and an Imu has "
                                        f"m/s^2: multiply by {factor}")
        if self._disagreeing >= _VERDICT:
            faults["gyro_unit"] = ("the gyro turns and gravity does not follow: are the rates in deg/s? An Imu has "
                                   "rad/s: multiply by pi/180")
        if self._upside_down:
            faults["upside_down"] = ("at rest the z axis reads -1 g: the IMU is mounted upside down (set mounting_rpy) "
                                     "or gives the force with the wrong sign (REP-145: +g on the axis that is up)")
        return faults

    def _begin(self, stamp_ns):
        self._start_ns = stamp_ns
        self._count = 0
        self._sums = [0.0] * 6

    def _judge(self, elapsed):
        means = [total / self._count for total in self._sums]
        rate, force = means[:3], means[3:]
        size = math.hypot(*force)
        if not 0.0 < size < math.inf or not math.isfinite(sum(rate)):
            self._last = None
            return
        self._sizes.append(size)
        direction = [component / size for component in force]
        if self._last is not None:
            last_direction, last_size = self._last
            turned = math.dist(direction, last_direction)
            steady = turned < 0.01 and abs(size - last_size) < 0.02 * size and math.hypot(*rate) < _STANDING_RATE
            self._steady = self._steady + 1 if steady else 0
            if self.standing:
                up = sum(a * b for a, b in zip(direction, self.up_imu, strict=True))
                self._upside_down = up < _UPSIDE_DOWN and abs(size - GRAVITY) < _GRAVITY_SHARE * GRAVITY
            if abs(size - GRAVITY) < _GRAVITY_SHARE * GRAVITY > abs(last_size - GRAVITY):
                self._compare(rate, direction, turned / elapsed)
        self._last = direction, size

    def _compare(self, rate, direction, turned):
        along = sum(w * u for w, u in zip(rate, direction, strict=True))
        across = math.sqrt(max(sum(w * w for w in rate) - along * along, 0.0))
        if across < _TURN:
            return
        if across > _FAST_TURN and turned < _DISAGREE * across:
            self._disagreeing += 1
        elif turned > _AGREE * across:
            self._disagreeing = max(self._disagreeing - 3, 0)
