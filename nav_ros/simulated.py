"""Every scenario by its name: motions with an IMU and what aids it, turntables and parked vehicles with an IMU."""

from inertial.flight_scenarios import FLIGHT_SCENARIOS, simulate_flight
from inertial.parked_scenarios import PARKED_SCENARIOS, simulate_parked
from inertial.scenarios import SCENARIOS
from inertial.simulator import simulate
from inertial.table_scenarios import TABLE_SCENARIOS, simulate_table

_AT_REST = dict.fromkeys(TABLE_SCENARIOS, simulate_table) | dict.fromkeys(PARKED_SCENARIOS, simulate_parked)

DESCRIPTIONS = {
    name: scenario.description
    for name, scenario in (SCENARIOS | FLIGHT_SCENARIOS | TABLE_SCENARIOS | PARKED_SCENARIOS).items()}
"""Name -> what it is."""


def simulate_scenario(name, *, duration, imu_rate, altimeter_rate, errors="", seed=0, rest=3.0):
    """Return a simulated recording of a scenario of any kind.

    Parameters
    ----------
    name : str
        Of :data:`DESCRIPTIONS`.
    duration : float, s
    imu_rate : float, Hz
    altimeter_rate : float, Hz
        Of a motion; what stands on the ground has no altimeter.
    errors : str
        Profile of :data:`inertial.imu_errors.PROFILES` for a motion, consumer by default; turntables and
        parked vehicles have the grade of their name.
    seed : int
    rest : float, s
        Standing still at the start of a motion.

    Returns
    -------
    inertial.recording.Recording

    Raises
    ------
    ValueError
        Unknown names, figures out of range, or errors given for sensors that have a grade.
    """
    if name not in DESCRIPTIONS:
        raise ValueError(f"unknown scenario {name!r}: choose from {', '.join(DESCRIPTIONS)}")
    if name in _AT_REST:
        if errors:
            raise ValueError(f"errors = {errors!r}: {name} has the sensors of its grade, leave it out")
        return _AT_REST[name](name, duration=duration, imu_rate=imu_rate, seed=seed)
    in_motion = simulate_flight if name in FLIGHT_SCENARIOS else simulate
    return in_motion(name, duration=duration, imu_rate=imu_rate, altimeter_rate=altimeter_rate,
                     profile=errors or "consumer", seed=seed, rest=rest)
