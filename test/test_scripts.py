"""scripts/run and scripts/find_python on machines unlike this one: pretended tools, nothing installed."""

import os
import shutil
import subprocess
import sys

import pytest

TOOLS = ("basename", "cat", "cksum", "dirname", "env", "grep", "pwd", "sed", "sh", "tr", "uname")
RUN_TIMEOUT = 60.0  # s, generous


@pytest.fixture
def machine(repository, tmp_path):
    """Return a bare machine: a copy of the scripts, and a PATH that has a few tools and no Python."""
    return Machine(repository, tmp_path)


class Machine:
    def __init__(self, repository, folder):
        self.root, self.bin, self.ros = folder / "checkout", folder / "bin", folder / "ros"
        self.bin.mkdir()
        self.ros.mkdir()
        shutil.copytree(repository / "scripts", self.root / "scripts")
        for name in ("setup.py", "pyproject.toml", "constraints.txt"):
            shutil.copy(repository / name, self.root)
        for name in TOOLS:
            (self.bin / name).symlink_to(shutil.which(name))

    def add(self, name, script):
        path = self.bin / name
        path.unlink(missing_ok=True)
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)

    def run(self, script, *arguments, **environment):
        environment = {"PATH": str(self.bin), "ATTITUDE_ROS_ROOT": str(self.ros)} | environment
        return subprocess.run([self.root / "scripts" / script, *arguments], env=environment, text=True,
                              capture_output=True, stdin=subprocess.DEVNULL, timeout=RUN_TIMEOUT)

    def add_python(self, name="python3"):
        self.add(name, f'exec "{os.path.realpath(sys.executable)}" "$@"')

    def add_ros(self):
        (self.ros / "jazzy").mkdir()
        (self.ros / "jazzy" / "setup.sh").write_text("export AMENT_PREFIX_PATH=pretended\n")


def one_sentence(done):
    assert done.returncode == 1
    assert done.stdout == ""
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_no_python(machine):
    assert one_sentence(machine.run("find_python")) == "No usable Python 3.10 to 3.14 on PATH."


def test_a_dead_shim_is_passed_over(machine):
    machine.add("python3.14", "echo 'pyenv: python3.14: command not found' >&2; exit 127")
    machine.add_python()
    assert machine.run("find_python").stdout.strip() == str(machine.bin / "python3")


def test_the_newest_is_taken(machine):
    machine.add_python()
    machine.add_python("python3.13")
    machine.add_python("python3.12")
    assert machine.run("find_python").stdout.strip() == str(machine.bin / "python3.13")


def test_a_python_without_venv_is_named(machine):
    sentence = "/usr/bin/python3 (Python 3.12) has no venv module: sudo apt install python3.12-venv"
    machine.add("python3", f"echo '{sentence}' >&2; exit 1")
    assert sentence in one_sentence(machine.run("find_python"))


def test_other_processors_are_told(machine):
    machine.add_python()
    machine.add("uname", 'case $1 in -s) echo Linux ;; *) echo aarch64 ;; esac')
    assert "x86-64" in one_sentence(machine.run("run", "--dry-run", "study", "attitude_demo"))


def test_without_ros_a_venv_is_made(machine):
    machine.add_python()
    done = machine.run("run", "--dry-run", "study", "attitude_demo", "--rate", "2")
    steps = done.stdout.splitlines()
    assert done.returncode == 0 and "colcon" not in done.stdout
    assert steps[0].endswith(f"-m venv --clear {machine.root}/.venv")
    assert "--editable" in steps[1] and "[ros,study]" in steps[1]
    assert steps[-1] == "exec attitude_demo --rate 2"


@pytest.mark.parametrize("environment", [{}, {"ROS_DISTRO": "jazzy"}])
def test_with_ros_colcon_builds_and_pip_is_not_called(machine, environment):
    machine.add_ros()
    machine.add("python3", "exit 0")
    machine.add("colcon", "exit 0")
    done = machine.run("run", "--dry-run", "study", "attitude_demo", **environment)
    assert done.returncode == 0 and "venv" not in done.stdout and "pip" not in done.stdout
    assert "exec attitude_demo" in done.stdout and "local_setup.sh" in done.stdout
    assert "--packages-select attitude_alignment" in done.stderr


def test_with_ros_but_without_colcon(machine):
    machine.add_ros()
    machine.add("python3", "exit 0")
    assert "colcon is missing" in one_sentence(machine.run("run", "study", "attitude_demo"))


def test_with_ros_what_cannot_be_imported_is_named(machine):
    machine.add_ros()
    machine.add("colcon", "exit 0")
    machine.add("python3", 'case $2 in *rosbags*) exit 1 ;; esac')
    sentence = one_sentence(machine.run("run", "study", "attitude_demo"))
    assert "cannot import: rosbags" in sentence and "numpy" not in sentence


def test_ros_that_is_named_but_not_there(machine):
    done = machine.run("run", "study", "attitude_demo", ROS_DISTRO="lunar")
    assert "setup.sh is missing" in one_sentence(done)
