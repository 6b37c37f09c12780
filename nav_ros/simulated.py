"""Every scenario by its name: motions with an IMU and an altimeter, turntables with an IMU."""

from inertial.scenarios import SCENARIOS
from inertial.simulator import simulate
from inertial.table_scenarios import TABLE_SCENARIOS, simulate_table

DESCRIPTIONS = {name: scenario.description for name, scenario in (SCENARIOS | TABLE_SCENARIOS).items()}
"""Name -> what it is."""


def simulate_scenario(name, *, duration, imu_rate, altimeter_rate, errors="", seed=0, rest=3.0):
    """Return a simulated recording of a scenario of either kind.

    Parameters
    ----------
    name : str
        Of :data:`DESCRIPTIONS`.
    duration : float, s
    imu_rate : float, Hz
    altimeter_rate : float, Hz
        Of a motion; a turntable has no altimeter.
    errors : str
        Profile of :data:`inertial.imu_errors.PROFILES` for a motion, consumer by default; a turntable has the
        grade of its name.
    seed : int
    rest : float, s
        Standing still at the start of a motion.

    Returns
    -------
    inertial.recording.Recording

    Raises
    ------
    ValueError
        Unknown names, figures out of range, or errors given for a turntable.
    """
    if name not in DESCRIPTIONS:
        raise ValueError(f"unknown scenario {name!r}: choose from {', '.join(DESCRIPTIONS)}")
    if name in TABLE_SCENARIOS:
        if errors:
            raise ValueError(f"errors = {errors!r}: {name} has the sensors of its grade, leave it out")
        return simulate_table(name, duration=duration, imu_rate=imu_rate, seed=seed)
    return simulate(name, duration=duration, imu_rate=imu_rate, altimeter_rate=altimeter_rate,
                    profile=errors or "consumer", seed=seed, rest=rest)
