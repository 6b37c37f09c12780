"""Timing on a shared machine: what is compared takes turns, and the least counts: others only add to it."""

import time

ROUNDS = 5


def times_in_turn(functions, samples, clock=time.perf_counter, rounds=ROUNDS):
    """Return name -> least microseconds per sample.

    Parameters
    ----------
    functions : dict
        Name -> callable that handles ``samples`` samples, or as many as its attribute ``samples`` says.
    samples : int
    clock : callable
        ``time.process_time`` leaves out what others do meanwhile; it is coarse, and blind to child processes.
    rounds : int
    """
    for function in functions.values():
        function()
    taken = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            began = clock()
            function()
            taken[name].append((clock() - began) * 1e6 / getattr(function, "samples", samples))
    return {name: min(times) for name, times in taken.items()}


def print_table(title, values, reference):
    """Print name -> value, smallest first, with the ratio to the value named ``reference``."""
    print(title)
    base = values.get(reference)
    for name, value in sorted(values.items(), key=lambda item: item[1]):
        ratio = f"   {value / base:6.2f} x {reference}" if base else ""
        print(f"  {name:16} {value:10.3f}{ratio}")
    print(flush=True)
