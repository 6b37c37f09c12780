"""The rules of the house that a syntax tree can show: who imports whom, where ROS and plots may be.

Each rule takes a file's path inside the repository and its syntax tree and yields what breaks it. Each is
also given a line that must fail, so that no rule is a rule in name only.
"""

import ast
import sys
from pathlib import PurePosixPath

import pytest

PACKAGES = ("inertial", "attitude_estimator", "alignment", "nav_ros", "studies")

OURS_ALLOWED = {
    "inertial": {"inertial"},
    "attitude_estimator": {"inertial", "attitude_estimator"},
    "alignment": {"inertial", "alignment"},
    "nav_ros": {"inertial", "nav_ros"},
    "studies": set(PACKAGES),
}
CORE = ("inertial", "attitude_estimator", "alignment")
ROS = {
    "rclpy", "tf2_ros", "launch", "launch_ros", "ament_index_python", "rosbags", "rosidl_runtime_py",
    "action_msgs", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs", "rcl_interfaces",
    "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs", "tf2_msgs",
}
INERTIAL_AT_IMPORT = {"numpy", "numba"}
MUTATORS = {
    "add", "append", "clear", "discard", "extend", "insert", "pop", "popitem", "remove", "setdefault",
    "sort", "update",
}
MUTABLE_CALLS = {"list", "dict", "set", "bytearray", "defaultdict", "deque", "Counter", "OrderedDict"}


def package_of(path):
    return path.parts[0]


def is_edge(path):
    """Whether the file is a node or a command line, where the outside world comes in."""
    return path.name.endswith("node.py") or path.name == "cli.py"


def imports(tree):
    """Yield (line, top-level package, whether inside a function) of every import."""
    inside = {
        node
        for function in ast.walk(tree)
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
        for node in ast.walk(function)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module] if node.level == 0 else []
        else:
            continue
        for name in names:
            yield node.lineno, name.split(".")[0], node in inside


def imports_point_one_way(path, tree):
    package = package_of(path)
    allowed = set(OURS_ALLOWED[package])
    # edge.py is what a package's node and command line share.
    if package in CORE and package != "inertial" and (is_edge(path) or path.name == "edge.py"):
        allowed.add("nav_ros")
    for line, name, _ in imports(tree):
        if name in PACKAGES and name not in allowed:
            yield line, f"{package} imports {name}"


def inertial_stands_on_numpy(path, tree):
    if package_of(path) != "inertial":
        return
    for line, name, inside in imports(tree):
        known = name in INERTIAL_AT_IMPORT or name in sys.stdlib_module_names or name == "inertial"
        if not known and not (name == "scipy" and inside):
            yield line, f"inertial imports {name}"


def ros_at_the_edge(path, tree):
    if package_of(path) == "nav_ros" or is_edge(path):
        return
    for line, name, _ in imports(tree):
        if name in ROS:
            yield line, f"{name} outside of the ROS edge"


def plots_where_they_are_drawn(path, tree):
    may_draw = package_of(path) == "studies" or path.name == "plots.py"
    for line, name, inside in imports(tree):
        if name == "matplotlib" and not (may_draw and inside):
            yield line, "matplotlib outside of a function that draws"


def no_blanket_except(path, tree):
    if path.name.endswith("node.py"):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler):
            caught = node.type.elts if isinstance(node.type, ast.Tuple) else [node.type]
            if any(kind is None or getattr(kind, "id", "") in ("Exception", "BaseException")
                   for kind in caught):
                yield node.lineno, "catches everything"


def no_wall_clock_in_the_core(path, tree):
    if package_of(path) not in CORE or is_edge(path):
        return
    for line, name, _ in imports(tree):
        if name in ("time", "datetime"):
            yield line, f"{name} in an estimator: its time is that of the samples"


def no_exit_in_a_library(path, tree):
    if is_edge(path) or path.name == "demo.py" or package_of(path) == "studies":
        return
    for node in ast.walk(tree):
        exits = isinstance(node, ast.Name) and node.id in ("SystemExit", "exit", "quit")
        exits |= isinstance(node, ast.Attribute) and node.attr in ("exit", "_exit") \
            and getattr(node.value, "id", "") in ("sys", "os")
        if exits:
            yield node.lineno, "a library ends the process"


def no_state_in_modules(path, tree):
    mutable = set()
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and _makes_mutable(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            mutable |= {target.id for target in targets if isinstance(target, ast.Name)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Global):
            yield node.lineno, f"global {', '.join(node.names)}"
        changed = None
        if isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            changed = node.value
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in MUTATORS:
            changed = node.func.value
        if getattr(changed, "id", "") in mutable:
            yield node.lineno, f"{changed.id} of the module is changed"


def _makes_mutable(value):
    if isinstance(value, ast.Call):
        return getattr(value.func, "id", getattr(value.func, "attr", "")) in MUTABLE_CALLS
    return isinstance(value, (ast.List, ast.Dict, ast.Set, ast.ListComp, ast.DictComp, ast.SetComp))


RULES = [
    imports_point_one_way,
    inertial_stands_on_numpy,
    ros_at_the_edge,
    plots_where_they_are_drawn,
    no_blanket_except,
    no_wall_clock_in_the_core,
    no_exit_in_a_library,
    no_state_in_modules,
]

BROKEN = [
    (imports_point_one_way, "inertial/earth.py", "from nav_ros.frames import swap_flu_frd"),
    (imports_point_one_way, "attitude_estimator/estimator.py", "import nav_ros.frames"),
    (imports_point_one_way, "attitude_estimator/node.py", "from alignment import levelling"),
    (imports_point_one_way, "alignment/levelling.py", "from attitude_estimator.params import AttitudeParams"),
    (imports_point_one_way, "nav_ros/bags.py", "def f():\n    import attitude_estimator"),
    (inertial_stands_on_numpy, "inertial/earth.py", "import pandas"),
    (inertial_stands_on_numpy, "inertial/earth.py", "from scipy.linalg import expm"),
    (ros_at_the_edge, "attitude_estimator/estimator.py", "from sensor_msgs.msg import Imu"),
    (ros_at_the_edge, "attitude_estimator/edge.py", "import rclpy"),
    (ros_at_the_edge, "studies/recordings.py", "def f():\n    from rosbags.rosbag2 import Reader"),
    (plots_where_they_are_drawn, "studies/recordings.py", "import matplotlib.pyplot as plt"),
    (plots_where_they_are_drawn, "nav_ros/bags.py", "def f():\n    import matplotlib"),
    (no_blanket_except, "nav_ros/bags.py", "try:\n    f()\nexcept Exception:\n    pass"),
    (no_blanket_except, "nav_ros/bags.py", "try:\n    f()\nexcept:\n    pass"),
    (no_blanket_except, "studies/bench.py", "try:\n    f()\nexcept (ValueError, BaseException):\n    pass"),
    (no_wall_clock_in_the_core, "inertial/simulator.py", "from time import perf_counter"),
    (no_wall_clock_in_the_core, "alignment/levelling.py", "import datetime"),
    (no_exit_in_a_library, "nav_ros/bags.py", "import sys\nsys.exit(1)"),
    (no_exit_in_a_library, "inertial/earth.py", "raise SystemExit(2)"),
    (no_state_in_modules, "inertial/earth.py", "cache = {}\ndef f(x):\n    cache[x] = 1"),
    (no_state_in_modules, "inertial/earth.py", "SEEN = set()\ndef f(x):\n    SEEN.add(x)"),
    (no_state_in_modules, "nav_ros/bags.py", "n = 0\ndef f():\n    global n\n    n += 1"),
]

SOUND = [
    ("inertial/rotation.py", "import math\nimport numpy as np\nfrom numba import njit"),
    ("attitude_estimator/node.py", "import time\nimport rclpy\nfrom nav_ros.frames import swap_flu_frd"),
    ("nav_ros/demo.py", "import sys\ndef main():\n    sys.exit(1)"),
    ("nav_ros/plots.py", "def draw():\n    import matplotlib"),
    ("nav_ros/replay_node.py", "try:\n    f()\nexcept Exception:\n    raise"),
    ("nav_ros/bags.py", "TOPICS = {'imu': '/imu'}\ndef f(x):\n    own = dict(TOPICS)\n    own[x] = 1"),
]


def broken_rules(path, source, rules=RULES):
    path, tree = PurePosixPath(path), ast.parse(source)
    return [f"{path}:{line}: {what}" for rule in rules for line, what in rule(path, tree)]


def test_the_sources_keep_every_rule(repository):
    files = [path for package in PACKAGES for path in sorted((repository / package).rglob("*.py"))]
    assert len(files) > 10, "the walk misses the sources"
    found = [
        line
        for path in files
        for line in broken_rules(path.relative_to(repository).as_posix(), path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(("rule", "path", "source"), BROKEN)
def test_each_rule_can_fail(rule, path, source):
    assert broken_rules(path, source, [rule])


def test_no_rule_is_without_a_failing_line():
    assert {rule for rule, _, _ in BROKEN} == set(RULES)


@pytest.mark.parametrize(("path", "source"), SOUND)
def test_sound_code_passes(path, source):
    assert not broken_rules(path, source)
