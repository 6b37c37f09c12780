"""The named motions: what each vehicle does, as tables of manoeuvres.

Every scenario stands still for ``rest`` seconds, starts, and then repeats its cycle of manoeuvres
for as long as needed, every other time to the other side and each time at another pace. Cycles are
closed: they end at the altitude at which they began.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from inertial.helicopter import helicopter_flight
from inertial.trajectory import Profile, car, flight, multirotor

_PACES = (1.0, 1.12, 0.95, 1.05)


@dataclass(frozen=True)
class Scenario:
    """A named motion.

    Attributes
    ----------
    description : str
    motion : callable
        ``motion(duration, rest, gravity)`` returns a function of time that gives
        :class:`inertial.trajectory.Motion`; seconds, seconds, m/s^2.
    """

    description: str
    motion: Callable


# Rows: seconds, speed m/s, pitch step deg, turn rate deg/s, roll step deg.
_STRAIGHT = [(60, 25, 0, 0, 0)]
_TURN = [
    (3, 25, 0, 13, 0), (25, 25, 0, 13, 0), (5, 25, 0, -13, 0), (12, 25, 0, -13, 0),
    (3, 25, 0, 0, 0), (4, 25, 0, 0, 0), (2.5, 25, 5, 20, 0), (8, 25, 0, 20, 0),
    (4, 25, -10, 20, 0), (8, 25, 0, 20, 0), (2.5, 25, 5, 0, 0), (3, 20, 0, 0, 0),
    (3, 25, 0, 0, 0),
]
_VERTICAL_PLANE = [
    (3, 45, 40, 0, 0), (7, 45, -80, 0, 0), (3, 50, 40, 0, 0), (1.5, 50, 0, 0, 0),
    (2.5, 50, 25, 0, 0), (2, 50, 0, 0, 0), (5, 50, -50, 0, 0), (2, 50, 0, 0, 0),
    (2.5, 50, 25, 0, 0), (3, 42, 0, 0, 0), (3, 50, 0, 0, 0),
]
_AEROBATIC = [
    # Loop, roll, steep turns.
    (14, 45, 360, 0, 0), (1, 45, 0, 0, 0), (5, 45, 0, 0, 360), (1, 45, 0, 0, 0),
    (3, 45, 0, 25, 0), (10, 45, 0, 25, 0), (5, 45, 0, -25, 0), (5, 45, 0, -25, 0),
    (3, 45, 0, 0, 0),
    # Up with a roll and over the top, half a roll to upright, half a roll back, down again.
    (4, 45, 75, 0, 0), (4, 45, 0, 0, 360), (5, 45, 105, 0, 0), (3, 45, 0, 0, 180),
    (2, 45, 0, 0, 0), (3, 45, 0, 0, -180), (5, 45, 105, 0, 0), (4, 45, 0, 0, 0),
    (4, 45, 75, 0, 0), (2, 45, 0, 0, 0),
    # Climbing and diving turn, a second of inverted flight.
    (5, 45, 12, 20, 0), (6, 45, -24, 20, 0), (5, 45, 12, 0, 0), (3, 45, 0, 0, 180),
    (1, 45, 0, 0, 0), (3, 45, 0, 0, -180),
]
# Rows: seconds, velocity north, east, up m/s, turn rate deg/s.
_LIFT_OFF = [(3, 0, 0, 2, 0), (2, 0, 0, 2, 0), (3, 0, 0, 0, 0)]
_HOVER = [
    (4, 0.4, -0.2, 0.1, 0), (5, -0.3, 0.3, -0.2, 5), (4, 0.2, 0.1, 0.2, -3),
    (6, -0.4, -0.3, -0.1, -5), (5, 0.1, 0.1, 0, 3), (3, 0, 0, 0, 0),
]
_QUAD = [
    (2.5, 7, 0, 0, 0), (3, 7, 0, 1, 0), (2.5, 0, 0, 0, 30), (2, 0, 6, 0, 30), (3, 0, 6, -1, 0),
    (2.5, -6, -4, 0, -40), (2, -6, -4, 0, 0), (2, -4, 4, 2, 0), (2.5, 3, -3, -2, 60),
    (2, -4, 0, 0, 0), (2, 0, -5, 0, -60), (3, 3, 0, 0, 0), (2, 0, 0, 0, 0),
]
# Rows: seconds, roll deg, pitch deg, turn rate deg/s, climb rate m/s.
_HELICOPTER_LIFT_OFF = [(3, 0, 0, 0, 2), (2, 0, 0, 0, 2), (3, 0, 0, 0, 0)]
_HELICOPTER = [
    # Ahead and to a stop, sideways and to a stop, about.
    (2, 0, -10, 0, 1), (4, 2, -6, 3, 0), (2, 0, 0, 0, 0), (3, -1, -3, 0, 0), (2.5, 0, 12, 0, 0),
    (2.5, 0, 9, 0, 0), (2, 0, 0, 0, 0), (1.5, 12, 1, 0, 0), (2, 9, 0, -4, 0), (1.5, 0, 0, 0, 0),
    (1.5, -12, 0, 0, 0), (1.5, -8, 1, 0, 0), (1.5, 0, 0, 0, 0), (3, 1, 0, 30, 0), (3, 0, 0, 0, 0),
    # A brisk turn, a quick stop.
    (1.5, 0, -18, 0, 0), (3, 0, -11, 0, 0), (2, 20, -4, 25, -1), (4, 16, 0, 25, 0), (2, 0, 4, 0, 0),
    (2, -6, 20, 0, 0), (2, -3, 15, 0, 0), (2, 0, 0, -20, 0), (2, 1, 0, 0, 0), (3, 0, 2, 0, 0), (2, 0, 0, 0, 0),
]
# Rows: seconds, speed m/s.
_TRAFFIC = [
    (10, 14), (8, 14), (5, 6), (6, 6), (6, 12), (10, 12), (5, 0), (4, 0), (7, 9), (6, 9),
    (3.5, 0), (3, 0),
]
# Rows: metres, curvature 1/m, slope deg.
_ROAD = [
    (40, 0, 0), (15, 0.02, 0), (60, 0.02, 0), (15, 0, 0), (40, 0, 4), (40, 0, 4), (30, -0.015, 0),
    (30, -0.015, -4), (40, 0, -4), (40, 0, 0), (20, -0.02, 0), (30, 0.02, 0), (20, 0, 0),
]


def _aircraft(cycle, cruise, speed_lost_inverted=0.0):
    """Return the ``motion`` of a scenario that takes off and repeats a cycle of aerobatic rows."""
    take_off = [(10, cruise, 0, 0, 0), (3, cruise, 15, 0, 0), (2, cruise, 0, 0, 0),
                (3, cruise, -15, 0, 0), (2, cruise, 0, 0, 0)]

    def motion(duration, rest, gravity):
        rows = np.concatenate([take_off, _repeat(cycle, duration, mirror=[1, 1, 1, -1, -1])])
        rows[:, 2:] = np.radians(rows[:, 2:])
        rows[:, [2, 4]] = np.cumsum(rows[:, [2, 4]], axis=0)
        return flight(*_profiles(rest, rows), gravity, speed_lost_inverted)
    return motion


def _multirotor(cycle):
    """Return the ``motion`` of a scenario that lifts off and repeats a cycle of velocity rows."""
    def motion(duration, rest, gravity):
        rows = np.concatenate([_LIFT_OFF, _repeat(cycle, duration, mirror=[1, 1, -1, 1, -1])])
        rows[:, 4] = np.radians(rows[:, 4])
        return multirotor(*_profiles(rest, rows), gravity)
    return motion


def _helicopter(duration, rest, gravity):
    del gravity
    rows = np.concatenate([_HELICOPTER_LIFT_OFF, _repeat(_HELICOPTER, duration, mirror=[1, -1, 1, -1, -1])])
    rows[:, 1:4] = np.radians(rows[:, 1:4])
    knots = rest + np.concatenate([[0.0], np.cumsum(rows[:, 0])])
    return helicopter_flight(knots, *_profiles(rest, rows))


def _car(duration, rest, gravity):
    del gravity
    speed, = _profiles(rest, _repeat(_TRAFFIC, duration, mirror=[1, 1]))
    road = _repeat(_ROAD, speed.integral(rest + duration), mirror=[1, -1, 1])
    road[:, 2] = np.radians(road[:, 2])
    return car(speed, *_profiles(0.0, road))


def _repeat(cycle, length, mirror):
    """Return as many cycles as fill ``length``, (K, columns); every other one times ``mirror``."""
    cycles, filled = [], 0.0
    while filled < length or not cycles:
        k = len(cycles)
        rows = np.array(cycle, dtype=float) * (mirror if k % 2 else 1)
        rows[:, 0] *= _PACES[k % len(_PACES)]
        filled += rows[:, 0].sum()
        cycles.append(rows)
    return np.concatenate(cycles)


def _profiles(start, rows):
    """Return one profile per column after the first, which holds how long each row lasts."""
    knots = start + np.concatenate([[0.0], np.cumsum(rows[:, 0])])
    return [Profile(knots, np.concatenate([[0.0], column])) for column in rows[:, 1:].T]


SCENARIOS = {
    "straight": Scenario("an aircraft that takes off and then flies straight and level",
                         _aircraft(_STRAIGHT, 25)),
    "hover": Scenario("a multirotor that lifts off and then holds its place in light wind",
                      _multirotor(_HOVER)),
    "turn": Scenario("an aircraft in long coordinated turns at 30 to 42 deg of bank",
                     _aircraft(_TURN, 25)),
    "vertical_plane": Scenario("an aircraft that climbs and dives at up to 40 deg without turning",
                               _aircraft(_VERTICAL_PLANE, 50, 0.3)),
    "aerobatic": Scenario("an aircraft in loops, rolls and steep turns, through pitch +-90 deg",
                          _aircraft(_AEROBATIC, 45, 0.3)),
    "car": Scenario("a car in stop-and-go traffic with bends, hills and hard braking", _car),
    "quad": Scenario("a multirotor that darts about, tilting up to 50 deg", _multirotor(_QUAD)),
    "helicopter": Scenario("a small helicopter under its controller: dashes, sidesteps, brisk turns, quick stops",
                           _helicopter),
}


def find_scenario(name):
    """Return the scenario of that name.

    Raises
    ------
    ValueError
        There is none; the message lists the names.
    """
    if name not in SCENARIOS:
        raise ValueError(f"unknown scenario {name!r}: choose from {', '.join(SCENARIOS)}")
    return SCENARIOS[name]
