"""Parameters refuse what they cannot mean, and say why."""

import math
from dataclasses import dataclass, fields

import pytest

from inertial.parameters import check_parameters, parameter


@dataclass(frozen=True)
class Params:
    rate: float = parameter(10.0, "Hz", "How often.", 1.0, 100.0)
    gravity: float = parameter(float("nan"), "m/s^2", "Gravity.", 9.0, nan_means="WGS84")
    enabled: bool = parameter(True, "", "Whether.")
    method: str = parameter("fast", "", "Which.", choices=("fast", "exact"))
    position: tuple = parameter((0.0, 0.0, 0.0), "m", "Where.", -1.0, 1.0)
    latitude: float = parameter(0.5, "rad", "How far north.", -0.5 * math.pi, 0.5 * math.pi)

    def __post_init__(self):
        check_parameters(self)


@pytest.mark.parametrize("good", [
    {}, {"rate": 1}, {"rate": 100.0}, {"gravity": 9.8}, {"enabled": False}, {"method": "exact"},
    {"position": (1.0, -1.0, 0)}])
def test_values_in_range_are_kept(good):
    params = Params(**good)
    for name, value in good.items():
        assert getattr(params, name) == value


@pytest.mark.parametrize("bad, message", [
    ({"rate": 0.5}, r"rate = 0.5 Hz: must be from 1.0 to 100.0 Hz"),
    ({"rate": 101.0}, r"rate = 101.0 Hz"),
    ({"rate": float("nan")}, r"rate = nan: must be a number in Hz"),
    ({"rate": float("inf")}, r"rate = inf Hz"),
    ({"rate": "10"}, r"rate = '10': must be a number in Hz"),
    ({"rate": True}, r"rate = True: must be a number in Hz"),
    ({"gravity": 8.0}, r"gravity = 8.0 m/s\^2: must be from 9.0 to inf"),
    ({"enabled": 1}, r"enabled = 1: must be true or false"),
    ({"method": "slow"}, r"method = 'slow': must be one of fast, exact"),
    ({"position": (0.0, 0.0)}, r"position needs 3 values, got 2"),
    ({"position": (0.0, 2.0, 0.0)}, r"position = 2.0 m"),
    ({"latitude": 35.0}, r"from -1.5708 to 1.5708 rad; 35 deg are 0.610865 rad$"),
    ({"latitude": 91.0}, r"to 1.5708 rad$"),
])
def test_bad_values_are_refused_by_name_value_and_unit(bad, message):
    with pytest.raises(ValueError, match=message):
        Params(**bad)


def test_every_field_describes_itself():
    for field in fields(Params):
        assert set(field.metadata) == {"unit", "description", "minimum", "maximum", "choices",
                                       "nan_means", "runtime"}
