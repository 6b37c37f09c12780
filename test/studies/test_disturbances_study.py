"""A small run of the study of disturbances writes both tables; its vehicle obeys the physics."""

import math

import numpy as np
import pytest

from inertial.earth import earth_rate_n, normal_gravity
from inertial.rotation import dcm_from_quaternion
from inertial.table_scenarios import LATITUDE
from studies import disturbances as study

ROUNDING = 1e-9  # m/s^2; differences of positions in time
RATE_TOLERANCE = 1e-9  # rad/s, of quaternions' logarithms
MEAN_VELOCITY = 0.02  # m/s that a rocking body may have at the end of its path


def test_a_small_run_has_a_row_for_every_fault(tmp_path, monkeypatch):
    faults = [fault for fault in study.TABLE_FAULTS if fault.name in (
        "none", "joint counts the wrong way", "1 % of the samples not numbers", "turns one way")]
    cases = [case for case in study.VEHICLE_DISTURBANCES if case.name in ("nothing", "all of these")]
    for name, value in {"TABLE_FAULTS": faults, "VEHICLE_DISTURBANCES": cases, "TABLE_TIME": 80.0, "TABLE_RATE": 20.0,
                        "VEHICLE_TIME": 50.0, "MARKS": (40.0, 50.0)}.items():
        monkeypatch.setattr(study, name, value)
    study.main(["--out", str(tmp_path), "--seeds", "1", "--workers", "1"])
    text = (tmp_path / "disturbances.md").read_text(encoding="utf-8")
    rows = {line.split(" | ")[0][2:]: line for line in text.splitlines() if line.startswith("| ")}
    assert {fault.name for fault in faults} | {case.name for case in cases} <= set(rows)
    assert "must be counter-clockwise" in rows["joint counts the wrong way"]
    says = {name: line.split(" | ")[1] for name, line in rows.items()}
    assert says["1 % of the samples not numbers"] == says["none"] == "positions"
    assert "nan" not in text


@pytest.mark.parametrize("kinds", [(), study.EVERYTHING])
def test_the_vehicle_reads_what_its_motion_makes_of_earth_rate_and_gravity(kinds):
    imu, q_nb = study.standing_vehicle(kinds, 1.0, seed=3, duration=20.0, rate=50.0)
    dcm_nb = dcm_from_quaternion(q_nb)
    gravity_n = np.array([0.0, 0.0, float(normal_gravity(LATITUDE))])
    still_gyro = np.einsum("kji,j->ki", dcm_nb, earth_rate_n(LATITUDE))
    if not kinds:
        np.testing.assert_allclose(imu.gyro_b, still_gyro, atol=RATE_TOLERANCE)
        np.testing.assert_allclose(imu.accel_b, -dcm_nb[0].T @ gravity_n + np.zeros_like(imu.accel_b), atol=ROUNDING)
    velocity_n = np.sum(np.einsum("kij,kj->ki", dcm_nb, imu.accel_b) + gravity_n, axis=0) / 50.0
    assert math.hypot(*velocity_n) < MEAN_VELOCITY
