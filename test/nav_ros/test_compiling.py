"""Compilations are told as they happen, and once."""

import importlib.util
import subprocess
import sys

import pytest

from nav_ros.cli import one_line_errors
from nav_ros.compiling import compilations_told

SOURCE = """
from numba import njit

@njit
def half(x):
    return 0.5 * x

@njit(cache=True)
def kernel(x):
    return half(x) + 1.0
"""


@pytest.fixture
def load(tmp_path):
    """Return a function that loads the module with the kernel anew."""
    file = tmp_path / "kernels_for_test.py"
    file.write_text(SOURCE)

    def load():
        spec = importlib.util.spec_from_file_location("kernels_for_test", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
    return load


def test_a_kernel_is_told_when_it_is_compiled_and_not_when_it_is_loaded(load):
    told = []
    first = load().kernel
    with compilations_told(told.append):
        assert first(2.0) == first(2.0) == 2.0
    assert told == [f"compiling kernel (once; kept in {first.stats.cache_path})"]
    with compilations_told(told.append):
        assert load().kernel(2.0) == 2.0
    load().kernel(2)  # another type, compiled again, with nobody to tell
    assert len(told) == 1


def test_a_long_compilation_says_where_it_is(load, monkeypatch):
    monkeypatch.setattr("nav_ros.compiling.TOLD_AGAIN", 0.0)
    told = []
    with compilations_told(told.append):
        load().kernel(2.0)
    assert told[1:] == ["compiling kernel: at half"]


def test_the_compiler_starts_without_scipy_which_may_be_imported_afterwards():
    pytest.importorskip("scipy", reason="scipy is not installed")
    code = ("import sys; from nav_ros.compiling import start_compiler; start_compiler();"
            "assert 'numba.np.arraymath' in sys.modules and 'scipy.linalg' not in sys.modules;"
            "from scipy.linalg import expm; start_compiler(); assert 'scipy.linalg' in sys.modules")
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_tool_tells_it_on_a_terminal_only(load, capsys, monkeypatch):
    with one_line_errors("tool"):
        load().kernel(2.0)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with one_line_errors("tool"):
        load().kernel(2)  # another type
    assert capsys.readouterr().err.startswith("tool: compiling kernel (once; kept in ")
