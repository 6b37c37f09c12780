"""`colcon build` makes an ordinary ament package of a checkout, and its programs run from there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = "attitude_alignment"
TIMEOUT = 300.0  # s, generous: only a build that hangs is late


@pytest.fixture(scope="module")
def installed(repository, tmp_path_factory):
    """Build a copy of the tracked files; return the package's install folder."""
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / PACKAGE
    for name in ("package.xml", "setup.py", "setup.cfg", "pyproject.toml"):
        source.mkdir(parents=True, exist_ok=True)
        shutil.copy(repository / name, source)
    for name in ("inertial", "attitude_estimator", "alignment", "nav_ros", "studies", "resource", "config",
                 "launch", "bags"):
        shutil.copytree(repository / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    colcon = shutil.which("colcon", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    assert colcon, "colcon belongs to the test extra"
    done = subprocess.run([colcon, "build"], cwd=workspace, capture_output=True, text=True, timeout=TIMEOUT,
                          stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 package finished" in done.stdout
    return workspace / "install" / PACKAGE


def run(installed, name, *arguments, cwd):
    """Run an installed program with only the installed packages of ours on the path."""
    site = next((installed / "lib").glob("python3*/site-packages"))
    # Compiling everything anew for another place would take minutes; a bag of seconds runs without.
    environment = os.environ | {"PYTHONPATH": str(site), "AMENT_PREFIX_PATH": str(installed),
                                "NUMBA_DISABLE_JIT": "1"}
    return subprocess.run([installed / "lib" / PACKAGE / name, *arguments], env=environment, cwd=cwd,
                          capture_output=True, text=True, timeout=TIMEOUT, stdin=subprocess.DEVNULL)


@pytest.mark.parametrize("name", ["attitude_node", "replay_node", "estimate_bag", "simulate_bag", "score_bag",
                                  "attitude_demo"])
def test_executables_are_where_ros2_run_looks(installed, name):
    assert os.access(installed / "lib" / PACKAGE / name, os.X_OK)


def test_ament_index_has_the_package(installed):
    assert (installed / "share/ament_index/resource_index/packages" / PACKAGE).is_file()
    for name in ("package.xml", "config/attitude.yaml", "launch/attitude.launch.py", "launch/node.launch.py",
                 "bags/turns/metadata.yaml"):
        assert (installed / "share" / PACKAGE / name).is_file(), name


def test_a_bag_goes_through_the_installed_tools(installed, tmp_path):
    for arguments in (("simulate_bag", "turn", "flight", "--duration", "7", "--imu-rate", "50"),
                      ("estimate_bag", "flight", "estimated"),
                      ("score_bag", "estimated", "--json")):
        done = run(installed, *arguments, cwd=tmp_path)
        assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
    assert '"tilt_rms_deg"' in done.stdout


def test_installed_resources_are_found(installed, tmp_path):
    site = next((installed / "lib").glob("python3*/site-packages"))
    code = ("import nav_ros.resources as r; print(r.__file__); print(r.bundled_bag('turns')); "
            "print(r.executable('replay_node'))")
    environment = os.environ | {"PYTHONPATH": str(site), "AMENT_PREFIX_PATH": str(installed)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True,
                          text=True, check=True)
    module, bag, _ = done.stdout.split()
    assert Path(module).is_relative_to(site)
    assert Path(bag) == installed / "share" / PACKAGE / "bags" / "turns"
