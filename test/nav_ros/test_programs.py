"""The beginning of a program: Ctrl-C while it imports, and after."""

import signal
import subprocess
import sys

import pytest

LIMIT = 60.0  # s, generous: only a program that hangs is late
# A shell's background jobs, as which tests may run, ignore SIGINT.
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from nav_ros.programs import program
sys.exit(program("of_a_test")())
"""


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a program of a module with some source, and waits until it has said ``here``."""
    def start(source):
        (tmp_path / "of_a_test.py").write_text(source)
        process = subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                   text=True, env={"PYTHONPATH": f"{tmp_path}:{':'.join(sys.path)}"})
        processes.append(process)
        assert process.stdout.readline() == "here\n", process.communicate()
        return process

    processes = []
    yield start
    for process in processes:
        process.kill()
        process.communicate()


def test_ctrl_c_during_the_imports_ends_a_program_without_a_word(start):
    process = start("import time; print('here', flush=True); time.sleep(1000.0)")
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=LIMIT) == ("", "")
    assert process.returncode == -signal.SIGINT  # a shell's status 130


def test_after_the_imports_it_is_an_exception_again_and_the_status_that_of_the_program(start):
    process = start("""
import time
def main():
    try:
        print("here", flush=True)
        time.sleep(1000.0)
    except KeyboardInterrupt:
        return 7
""")
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=LIMIT) == ("", "") and process.returncode == 7
