"""Compilation of kernels: a minute at the first start, which is told, and the compiler's own start, kept short."""

import contextlib
import importlib
import sys
import time

from numba.core import event

TOLD_AGAIN = 10.0
"""Seconds of one kernel's compilation from one line about it to the next."""


class _Listener(event.Listener):
    """Tells of numba's compilations; those of the functions that a kernel calls come inside its own."""

    def __init__(self, tell):
        self._tell, self._kernels, self._told = tell, [], 0.0

    def on_start(self, event):
        kernel = event.data["dispatcher"]
        self._kernels.append(kernel)
        now = time.monotonic()
        if len(self._kernels) == 1:
            folder = kernel.stats.cache_path
            self._say(f"compiling {kernel.__name__} (once" + (f"; kept in {folder})" if folder else ")"), now)
        elif now - self._told > TOLD_AGAIN:
            self._say(f"compiling {self._kernels[0].__name__}: at {kernel.__name__}", now)

    def on_end(self, event):
        self._kernels.pop()

    def _say(self, text, now):
        self._tell(text)
        self._told = now


def compilations_told(tell):
    """Return a context manager: what is compiled meanwhile is told, what comes from the cache is not.

    Parameters
    ----------
    tell : callable
        Takes a line of text.
    """
    return event.install_listener("numba:compile", _Listener(tell))


def start_compiler():
    """Let numba read what it knows of numpy, without scipy: no kernel here calls it, and it takes as long again."""
    there = sys.modules.get("scipy.linalg")
    sys.modules["scipy.linalg"] = there  # None: not to be imported
    try:
        with contextlib.suppress(ImportError):
            importlib.import_module("numba.np.arraymath")  # looks for the BLAS that scipy brings
    finally:
        if there is None:
            del sys.modules["scipy.linalg"]
