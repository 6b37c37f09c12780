"""Parameters on a node, in files and in the README's table."""

import math
import random
from dataclasses import dataclass

import pytest

from inertial.parameters import check_parameters, parameter
from nav_ros.parameters import (
    declare_parameters,
    load_parameter_file,
    on_change,
    parameter_names,
    parameter_table,
    params_from_values,
)


@dataclass(frozen=True)
class Params:
    noise: float = parameter(0.1, "rad/s", "White noise", 0.0, 1.0)
    latitude: float = parameter(math.nan, "rad", "Latitude", -1.6, 1.6, nan_means="unknown")
    count: int = parameter(3, "", "How many", 1, 9)
    method: str = parameter("fast", "", "Method", choices=("fast", "slow"), runtime=False)
    enabled: bool = parameter(True, "", "Whether at all")
    mounting: tuple = parameter((0.0, 0.0, 0.0), "rad", "Roll, pitch, yaw", -3.2, 3.2)
    tolerance: float = parameter(1.0, "s", "Only bounded below", 0.0)

    def __post_init__(self):
        check_parameters(self)


@pytest.fixture
def node_with(monkeypatch):
    rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
    monkeypatch.setenv("ROS_DOMAIN_ID", "91")
    made = []

    def make(*overrides):
        context = rclpy.Context()
        arguments = [item for override in overrides for item in ("-p", override)]
        rclpy.init(args=["--ros-args", *arguments] if arguments else [], context=context)
        node = rclpy.create_node("parameter_test", context=context)
        made.append((node, context))
        return node

    yield make
    for node, context in made:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def set_one(node, name, value):
    from rclpy.parameter import Parameter
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return result


def test_defaults_are_those_of_the_dataclass(node_with):
    node = node_with()
    params = declare_parameters(node, Params, "filter.")
    assert math.isnan(params.latitude)
    assert params_from_values(Params, {"latitude": 0.0}) == Params(latitude=0.0)
    assert node.get_parameter("filter.noise").value == 0.1


def test_values_from_outside_are_taken_and_an_integer_will_do_for_a_float(node_with):
    node = node_with("noise:=1", "method:=slow", "mounting:=[0, 0, 1]", "latitude:=0.5")
    params = declare_parameters(node, Params)
    assert params == Params(noise=1.0, method="slow", mounting=(0.0, 0.0, 1.0), latitude=0.5)
    assert type(params.noise) is float and type(params.mounting[2]) is float


@pytest.mark.parametrize("override, reason", [
    ("noise:=7.0", "noise = 7.0 rad/s: must be from 0.0 to 1.0 rad/s"), ("noise:=.nan", "noise = nan"),
    ("noise:=loud", "noise = 'loud': must be a number"), ("method:=odd", "must be one of fast, slow"),
    ("mounting:=[1.0]", "mounting needs 3 values"), ("mounting:=5", "mounting = 5: must be 3 values"),
    ("enabled:=1", "enabled = 1: must be true or false")])
def test_a_bad_value_at_the_start_is_told_in_one_line(node_with, override, reason):
    with pytest.raises(ValueError, match=reason.replace("[", r"\[")) as error:
        declare_parameters(node_with(override), Params)
    assert "\n" not in str(error.value)


def test_all_bad_values_are_told_at_once(node_with):
    node = node_with("noise:=7.0", "method:=odd", "mounting:=5", "count:=4")
    with pytest.raises(ValueError) as error:
        declare_parameters(node, Params)
    assert str(error.value) == ("noise = 7.0 rad/s: must be from 0.0 to 1.0 rad/s; "
                                "method = 'odd': must be one of fast, slow; mounting = 5: must be 3 values")


def test_descriptors_carry_meaning_unit_and_range(node_with):
    node = node_with()
    declare_parameters(node, Params)
    noise = node.describe_parameter("noise")
    assert noise.description == "White noise [rad/s]"
    assert noise.floating_point_range[0].to_value == 1.0
    assert node.describe_parameter("count").integer_range[0].to_value == 9
    assert node.describe_parameter("latitude").additional_constraints == "-1.6 to 1.6; .nan: unknown"
    assert node.describe_parameter("method").read_only and not noise.read_only


def test_changes_are_handed_over_and_bad_ones_refused_with_the_reason(node_with):
    node, seen = node_with(), []
    on_change(node, declare_parameters(node, Params), seen.append)
    assert set_one(node, "noise", 0.5).successful
    assert set_one(node, "latitude", 0.7).successful and set_one(node, "latitude", math.nan).successful
    assert set_one(node, "tolerance", 2).successful
    assert seen[-1].tolerance == 2.0 and type(seen[-1].tolerance) is float
    assert seen[1] == Params(noise=0.5, latitude=0.7) and math.isnan(seen[2].latitude)
    accepted = len(seen)
    for name, value, reason in [
            ("noise", 2.0, "noise"), ("noise", math.nan, "noise"), ("noise", "x", "must be a number"),
            ("latitude", 2.0, "latitude = 2.0 rad: must be from -1.6 to 1.6 rad"), ("count", 0, "count"),
            ("mounting", [1.0], "needs 3 values"), ("enabled", 3, "must be true or false"), ("noise", None, "noise"),
            ("method", "slow", "read-only")]:
        before = node.get_parameter(name).value
        result = set_one(node, name, value)
        assert not result.successful and reason in result.reason, (name, value, result.reason)
        after = node.get_parameter(name).value
        assert after == before or (math.isnan(after) and math.isnan(before))
    assert len(seen) == accepted


def test_a_check_of_the_node_may_refuse_too(node_with):
    node, seen = node_with(), []

    def check(params):
        if params.count == 4:
            raise ValueError("count = 4: not now")

    on_change(node, declare_parameters(node, Params, "a."), seen.append, "a.", check)
    assert set_one(node, "a.count", 4).reason == "count = 4: not now"
    assert set_one(node, "a.count", 5).successful and seen[-1].count == 5


def test_random_values_never_raise_and_never_get_through(node_with):
    node, seen = node_with(), []
    on_change(node, declare_parameters(node, Params), seen.append)
    rng = random.Random(4)
    values = [0, 1, -1, 2**40, 1e300, -1e300, math.inf, -math.inf, math.nan, "", "x", True, [], [1.0],
              [1.0, 2.0, 3.0], [1, 2, 3], [True], [math.nan] * 3, ["a", "b", "c"], [b"a"], None]
    for _ in range(400):
        set_one(node, rng.choice(parameter_names(Params)), rng.choice(values))
    assert seen
    for params in seen:
        check_parameters(params)


FILES = {
    "nodes": "/**:\n  ros__parameters:\n    noise: 1e-3\n    count: 4\n/ns/filter:\n  ros__parameters:\n"
             "    count: 5\n    use_sim_time: true\nother:\n  ros__parameters:\n    count: 9\n",
    "plain": "noise: 0.001\ncount: 5\n",
}


@pytest.mark.parametrize("kind", FILES)
def test_parameter_files(tmp_path, kind):
    file = tmp_path / "params.yaml"
    file.write_text(FILES[kind])
    values = load_parameter_file(file, "filter", parameter_names(Params))
    assert values == {"noise": 0.001, "count": 5}
    assert repr(params_from_values(Params, values)) == repr(Params(noise=1e-3, count=5))  # NaN is not NaN


def test_nested_names_take_dots(tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text("filter:\n  ros__parameters:\n    gate: {noise: 1, mounting: [0, 1, 2]}\n")
    values = load_parameter_file(file, "filter", parameter_names(Params, "gate."))
    assert params_from_values(Params, values, "gate.").mounting == (0.0, 1.0, 2.0)


@pytest.mark.parametrize("text, reason", [
    ("nose: 1\ncounter: 2\nuse_sim_time: true",
     "no parameter nose; did you mean noise? there is no parameter counter; did you mean count?"),
    ("- 1", "expected a mapping"),
    ("a: [", "cannot be read"), ("", "expected a mapping"),
    ("other:\n  ros__parameters: {noise: 1}", "nothing for filter in it, only for other"),
    ("filter:\n  ros__parameters: 5", "ros__parameters = 5: expected parameter names")])
def test_bad_parameter_files_are_told_in_one_line(tmp_path, text, reason):
    file = tmp_path / "params.yaml"
    file.write_text(text)
    with pytest.raises(ValueError) as error:
        load_parameter_file(file, "filter", parameter_names(Params))
    assert reason in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ValueError, match="cannot be read"):
        load_parameter_file(tmp_path / "none.yaml", "filter", [])


def test_the_table_has_a_row_for_each_parameter():
    rows = parameter_table(Params, "f.")
    assert len(rows) == 2 + len(parameter_names(Params))
    assert rows[2] == "| `f.noise` | 0.1 | rad/s | 0 to 1 | White noise |"
    assert rows[3] == "| `f.latitude` | .nan | rad | -1.6 to 1.6; .nan: unknown | Latitude |"
    assert rows[5] == "| `f.method` | fast | - | fast, slow | Method (at start only) |"
    assert rows[7] == "| `f.mounting` | [0, 0, 0] | rad | -3.2 to 3.2 | Roll, pitch, yaw |"
