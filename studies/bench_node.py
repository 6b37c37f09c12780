"""The part of the benchmark at the ROS edge: nodes as processes over DDS, and bags."""

import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rosbags.rosbag2 import Reader

from attitude_estimator.cli import estimate_bag
from attitude_estimator.edge import AttitudeNodeParams
from inertial.simulator import simulate
from nav_ros.bags import TOPICS, BagWriter
from nav_ros.demo import Listener, cpu_time, free_domain
from nav_ros.recorded import recorded_messages
from nav_ros.resources import executable
from studies.timing import print_table, times_in_turn

NODE_SECONDS = 12.0
NODE_ROUNDS = 3
NODE_RATES = (200.0, 1000.0)  # Hz
OFFLINE_SECONDS = 240.0
START_ROUNDS = 5


def bench_starts():
    """Seconds after which each node listens, its kernels compiled before, beside a relay."""
    commands = {"relay": [sys.executable, "-m", "studies.relay_node"]}
    commands |= {name: [str(executable(name))] for name in ("attitude_node", "navigation_node", "alignment_node")}
    environment = os.environ | {"ROS_DOMAIN_ID": str(free_domain())}
    rounds = [{name: _time_start(command, environment) for name, command in commands.items()}
              for _ in range(1 + START_ROUNDS)]
    result = {}
    for k, key in enumerate(("ready_after_s", "ready_after_cpu_s")):
        result[key] = {name: min(times[name][k] for times in rounds[1:]) for name in commands}
        print_table(key, result[key], "relay")
    return result


def _time_start(command, environment):
    """Return the seconds, and those of processor time, that a node takes to be ready."""
    began = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True) as node:
        said = ""
        for line in node.stdout:
            said += line
            if "]: ready" in line:
                took = time.perf_counter() - began, cpu_time(node.pid)
                node.terminate()
                return took
    raise RuntimeError(f"{command} ended: {said}")


def bench_nodes():
    """CPU per message and latency of attitude_node beside relays, in turn."""
    nodes = {"relay": [sys.executable, "-m", "studies.relay_node"],
             "relay of bytes": [sys.executable, "-m", "studies.relay_node", "raw"],
             "attitude_node": [str(executable("attitude_node"))]}
    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    rclpy.init()
    results = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as cleanup:
        cleanup.callback(rclpy.try_shutdown)
        for rate in NODE_RATES:
            bag = Path(folder) / f"imu_{rate:.0f}"
            _write_bag(bag, rate, NODE_SECONDS)
            runs = {name: [] for name in nodes}
            for _ in range(NODE_ROUNDS):
                for name, command in nodes.items():
                    node = rclpy.create_node("bench")
                    executor = SingleThreadedExecutor()
                    executor.add_node(node)
                    runs[name].append(_run_node(command, bag, executor, Listener(node)))
                    node.destroy_node()
            results[f"{rate:.0f} Hz"] = {
                name: {key: statistics.median(run[key] for run in values) for key in values[0]}
                for name, values in runs.items()}
            for key in results[f"{rate:.0f} Hz"]["relay"]:
                print_table(f"{rate:.0f} Hz: {key}",
                             {name: values[key] for name, values in results[f"{rate:.0f} Hz"].items()}, "relay")
    return results


def _write_bag(path, rate, seconds):
    """Write a bag of simulated turns; return how many messages it has."""
    recording = simulate("turn", duration=seconds, imu_rate=rate)
    types, messages = recorded_messages(recording)
    with BagWriter(path, types) as writer:
        writer.write_all(messages)
    return len(messages)


def _run_node(command, bag, executor, listener):
    """Return the figures of one node over one replay."""
    node = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    replay = subprocess.Popen(
        [str(executable("replay_node")), "--ros-args", "-p", f"bag:={bag}", "-p", "wait_for_subscribers:=2"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while len(listener.attitudes) < 200:
            executor.spin_once(timeout_sec=0.1)
        cpu, count = cpu_time(node.pid), len(listener.attitudes)
        while replay.poll() is None:
            executor.spin_once(timeout_sec=0.1)
        cpu, count = cpu_time(node.pid) - cpu, len(listener.attitudes) - count
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
    finally:
        for process in (node, replay):
            process.terminate()
            process.wait()
    latency = listener.latency() * 1e3
    return {"cpu_us_per_message": cpu / count * 1e6, "latency_ms_p50": float(np.percentile(latency, 50)),
            "latency_ms_p99": float(np.percentile(latency, 99)),
            "lost": len(listener.sent_at) - len(listener.attitudes)}


def bench_offline():
    """Speed of estimate_bag beside rosbags reading the same messages raw."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        count = _write_bag(bag, 200.0, OFFLINE_SECONDS)

        def read():
            with Reader(bag) as reader:
                for _ in reader.messages():
                    pass

        def estimate():
            estimate.runs += 1
            estimate_bag(bag, Path(folder) / f"out{estimate.runs}", AttitudeNodeParams(), TOPICS)

        estimate.runs = 0
        times = times_in_turn({"rosbags reads": read, "estimate_bag": estimate}, count)
    print_table("offline: microseconds per message", times, "rosbags reads")
    share = times["rosbags reads"] / times["estimate_bag"]
    seconds = times["estimate_bag"] * 1e-6 * count
    print(f"estimate_bag runs at {share:.0%} of the speed of reading alone (asked for: 30%), "
          f"{OFFLINE_SECONDS / seconds:.0f} times real time\n")
    return {"us_per_message": times, "share_of_reading": share}
