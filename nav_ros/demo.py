"""attitude_demo: the whole product once round, scored against the truth.

``replay_node`` plays a bundled flight and ``attitude_node`` estimates, each a process of its own, over DDS.
Another ``replay_node`` plays an IMU on a turntable in the namespace ``/table``, where ``alignment_node``
finds north. This process listens, compares with the truth in the bags, prints a table and writes
``report.html`` and ``attitude.png``. Exit status 1 when a figure is outside its stated bound or a process dies.
"""

import argparse
import contextlib
import math
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from inertial.bound import SensorNoise, tilt_bound
from inertial.imu_errors import find_profile
from inertial.rotation import dcm_from_quaternion, euler_from_dcm
from inertial.scoring import interpolate_down
from nav_ros.bags import TOPICS, read_recording
from nav_ros.estimated import attitude_run
from nav_ros.plots import attitude_picture
from nav_ros.report import Figure, score_figures, summary_of, text_table, write_report
from nav_ros.resources import bundled_bag, bundled_config, executable
from nav_ros.sensor_loop import init_interruptible

SIGMA_RATIO = (0.7, 1.2)  # error over what the filter predicts: below it is timid, above it overconfident
COVERAGE = 0.98  # of the time within three sigma
RATE = 2.0  # times real time: 400 Hz of a 200 Hz bag
PATIENCE = 60.0  # s for the first attitude, counted anew while attitude_node works: kernels to compile
WORKING = 0.05  # share of a processor above which it works; waiting for messages takes a hundredth
TABLE, TABLE_RATE = "/table", 4.0  # namespace, times real time
TABLE_LATITUDE = math.radians(35.0)
HEADING_SIGMA_DEG = 0.15  # after the two and a half minutes of the bundled turntable
HEADING_SIGMAS = 3.0
HEADING_REMARK = ("The heading is that of a turntable at rest, found in two and a half minutes from the Earth's "
                  "rotation alone; it is simulated with navigation-grade sensors.")
SETTLE_NS = 5_000_000_000  # left out of every score
QUIET = 1.0  # s without a message after the end of the replay
FAREWELL = 5.0  # s for a process to end after SIGINT
# Every event handler and service would be looked at for each message.
NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
QUEUE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)


class DemoError(Exception):
    """Raised when the demo cannot come to an end, with what its user should read."""


def cpu_time(pid):
    """Return the seconds of processor time that a process has used."""
    # The name, which may contain blanks, stands in parentheses; user and system time are fields 14, 15.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Process:
    """One of the package's executables, with what it says kept in a file."""

    def __init__(self, name, folder, arguments=(), label=""):
        self.name = name
        self._log = folder / f"{name}{label}.log"
        with self._log.open("w") as log:
            self._popen = subprocess.Popen([str(executable(name)), *arguments], stdin=subprocess.DEVNULL,
                                           stdout=log, stderr=subprocess.STDOUT)

    @property
    def said(self):
        """What the process has printed."""
        return self._log.read_text(errors="replace").strip()

    @property
    def status(self):
        """Exit status, None while it runs."""
        return self._popen.poll()

    def check(self):
        """Raise DemoError if the process has failed."""
        if self.status:
            raise DemoError(f"{self.name} ended with status {self.status}:\n{self.said or '(no word)'}")

    def cpu_time(self):
        """Return the seconds of processor time that the process has used."""
        return cpu_time(self._popen.pid)

    def end(self):
        """End the process as Ctrl-C does, by force if that takes too long."""
        if self.status is None:
            self._popen.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._popen.wait(FAREWELL)
        if self.status is None:
            self._popen.kill()
            self._popen.wait()


class Listener:
    """Keeps every IMU message in and every attitude out, with the time at which each was seen."""

    def __init__(self, node):
        self.sent_at, self.received_at, self.attitudes = {}, {}, []
        self.heading = None
        # The input first: of two waiting messages it is seen before its answer.
        for topic, callback in (("imu/data_raw", self._on_input), ("imu/data", self._on_output)):
            node.create_subscription(Imu, topic, callback, QUEUE, raw=True, event_callbacks=NO_EVENTS)
        node.create_subscription(PoseWithCovarianceStamped, f"{TABLE}/alignment/heading", self._on_heading,
                                 QUEUE, event_callbacks=NO_EVENTS)

    def _on_heading(self, message):
        self.heading = message

    def _on_input(self, raw):
        self.sent_at[raw[4:12]] = time.monotonic()

    def _on_output(self, raw):
        self.received_at[raw[4:12]] = time.monotonic()
        self.attitudes.append(raw)

    def latency(self):
        """Return the seconds from each input to its answer, (N,)."""
        return np.array([at - self.sent_at[stamp] for stamp, at in self.received_at.items()
                         if stamp in self.sent_at])


class Progress:
    """One line that renews itself on a terminal, and a plain line for each text elsewhere."""

    def __init__(self, stream):
        self._stream, self._live, self._text = stream, stream.isatty(), None

    def tell(self, text, share=None):
        """Show what is going on, with a bar for a share of it."""
        if self._live:
            bar = "" if share is None else f" [{'#' * round(30 * share):30}] {share:4.0%}"
            print(f"\r\x1b[K{text}{bar}", end="", file=self._stream, flush=True)
        elif text != self._text:
            print(text, file=self._stream, flush=True)
        self._text = text

    def close(self):
        """Leave a clean line."""
        if self._live and self._text:
            print("\r\x1b[K", end="", file=self._stream, flush=True)


def free_domain(domains=range(1, 101)):
    """Return a ROS domain in which nobody seems to be, by the UDP port its first participant takes."""
    for domain in random.sample(domains, len(domains)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7410 + 250 * domain))
            except OSError:
                continue
            return domain
    raise DemoError(f"every ROS domain from {domains[0]} to {domains[-1]} is in use")


def replay_and_listen(bag, expected, rate, folder, progress):
    """Run the processes until the bag is over.

    Returns
    -------
    listener : Listener
    cpu_per_message : float, s, of attitude_node
    """
    table_arguments = ["--ros-args", "-r", f"__ns:={TABLE}"]
    with contextlib.ExitStack() as cleanup:
        init_interruptible()
        cleanup.callback(rclpy.try_shutdown)
        node = rclpy.create_node("attitude_demo", enable_rosout=False, start_parameter_services=False)
        cleanup.callback(node.destroy_node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        listener = Listener(node)
        attitude = Process("attitude_node", folder)
        cleanup.callback(attitude.end)
        alignment = Process("alignment_node", folder, [
            *table_arguments, "--params-file", str(bundled_config("alignment_navigation.yaml")),
            "-p", f"latitude:={TABLE_LATITUDE}"])
        cleanup.callback(alignment.end)
        # Two subscribers, this process and attitude_node, which listens once its kernels are compiled.
        replay = Process("replay_node", folder, ["--ros-args", "-p", f"bag:={bag}", "-p", f"rate:={rate}",
                                                 "-p", "wait_for_subscribers:=2"])
        cleanup.callback(replay.end)

        _wait_for_attitude(executor, listener, attitude, replay, progress)
        table = Process("replay_node", folder, [
            *table_arguments, "-p", f"bag:={bundled_bag('turntable')}", "-p", f"rate:={TABLE_RATE}"],
            "_table")
        cleanup.callback(table.end)
        cpu_start, count_start = attitude.cpu_time(), len(listener.attitudes)
        processes = [attitude, replay, alignment, table]
        while replay.status is None or table.status is None:
            share = len(listener.attitudes) / expected
            progress.tell(f"replaying {bag.name} at {rate:g} times real time", share)
            _spin(executor, processes, 0.2)
        while _spin(executor, [attitude], QUIET) and len(listener.attitudes) < expected:
            pass
        handled = len(listener.attitudes) - count_start
        return listener, (attitude.cpu_time() - cpu_start) / max(handled, 1)


def _wait_for_attitude(executor, listener, attitude, replay, progress):
    since, used = time.monotonic(), 0.0
    while not listener.attitudes:
        _, compiles, kernel = attitude.said.rpartition("]: ")[2].partition("compiling ")
        progress.tell("waiting for attitude_node"
                      + (f", which compiles {kernel.partition(' (')[0]} (a minute in all, once)" if compiles else ""))
        _spin(executor, [attitude, replay], 0.2)
        if attitude.cpu_time() - used > WORKING * PATIENCE:
            since, used = time.monotonic(), attitude.cpu_time()
        if not listener.attitudes and (replay.status is not None or time.monotonic() - since > PATIENCE):
            raise DemoError(f"no attitude came; attitude_node said:\n{attitude.said}\n"
                            f"replay_node said:\n{replay.said}")


def _spin(executor, processes, seconds):
    """Serve messages for a while; return whether there were any."""
    for process in processes:
        process.check()
    deadline = time.monotonic() + seconds
    served = False
    while (left := deadline - time.monotonic()) > 0:
        before = time.monotonic()
        executor.spin_once(timeout_sec=left)
        served |= time.monotonic() - before < left
    return served


def demo_figures(score, sent, received, cpu_per_message, latency):
    """Return the :class:`nav_ros.report.Figure` rows of the table."""
    median, late = np.percentile(latency, [50, 99]) * 1e3
    return [
        *score_figures(score, SIGMA_RATIO, COVERAGE),
        Figure("IMU messages", f"{sent} sent, {received} answered", "all", sent == received),
        Figure("CPU per message", f"{cpu_per_message * 1e6:.0f} us", "of attitude_node, most of it rclpy's"),
        Figure("latency", f"{median:.1f} ms", f"median; 99 % within {late:.1f} ms"),
    ]


def bound_figure(recording):
    """Return the row with the Cramer-Rao bound of a simulated flight with the consumer profile's sensors."""
    down_b, spanned = interpolate_down(recording.truth, recording.imu.stamp_ns)
    settled = recording.imu.stamp_ns >= recording.imu.stamp_ns[0] + SETTLE_NS
    bound = tilt_bound(recording.imu, down_b, recording.altitude.stamp_ns,
                       SensorNoise.of(find_profile("consumer")))
    return Figure("Cramer-Rao bound", f"{math.degrees(np.median(bound.tilt_std[settled & spanned])):.2f} deg",
                  "median of the tilt sigma that this IMU and altimeter allow in this flight")


def heading_figures(message, truth):
    """Return the rows of the table for the last heading of ``alignment_node``, None if there was none.

    Parameters
    ----------
    message : geometry_msgs.msg.PoseWithCovarianceStamped or None
    truth : inertial.recording.AttitudeSeries
        Of the table at joint zero.
    """
    name, expected = "heading of the turntable", f"error at most {HEADING_SIGMAS:g} sigma"
    if message is None:
        return [Figure(name, "none", expected, False)]
    orientation = message.pose.pose.orientation
    yaw_deg = math.degrees(2.0 * math.atan2(orientation.z, orientation.w))
    heading_deg, sigma_deg = (90.0 - yaw_deg) % 360.0, math.degrees(math.sqrt(message.pose.covariance[35]))
    truth_deg = math.degrees(euler_from_dcm(dcm_from_quaternion(truth.q_nb_wxyz[-1]))[2]) % 360.0
    error = math.remainder(heading_deg - truth_deg, 360.0)
    return [
        Figure(name, f"{heading_deg:.2f} +- {sigma_deg:.2f} deg", f"truth {truth_deg:.2f} deg"),
        Figure("heading error", f"{error:+.3f} deg, {abs(error) / sigma_deg:.1f} sigma", expected,
               abs(error) <= HEADING_SIGMAS * sigma_deg),
        Figure("heading sigma", f"{sigma_deg:.3f} deg", f"at most {HEADING_SIGMA_DEG:g} deg",
               sigma_deg <= HEADING_SIGMA_DEG)]


def run_demo(options, progress):
    """Run, print the table, write the report; return whether every figure is within its bound."""
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    os.environ["ROS_LOG_DIR"] = str((options.out / "ros_log").resolve())
    recording = read_recording(options.bag)
    if recording.truth is None:
        raise DemoError(f"{options.bag} has no {TOPICS['truth']} to compare with")
    sent = len(recording.imu)
    listener, cpu_per_message = replay_and_listen(options.bag, sent, options.rate, options.out, progress)
    progress.tell("scoring")
    run = attitude_run(listener.attitudes, recording.truth)
    score = run.score()
    figures = demo_figures(score, sent, len(listener.attitudes), cpu_per_message, listener.latency())
    if recording.name == bundled_bag("turns").name:
        figures.insert(3, bound_figure(recording))
    figures += heading_figures(listener.heading, read_recording(bundled_bag("turntable")).truth)
    seconds = (recording.imu.stamp_ns[-1] - recording.imu.stamp_ns[0]) * 1e-9
    title = f"{recording.name}: {seconds:.0f} s at {sent / seconds:.0f} Hz, {options.rate:g} times real time"
    picture, report = attitude_picture(run), options.out / "report.html"
    (options.out / "attitude.png").write_bytes(picture)
    write_report(report, "Roll, pitch and heading against the truth", title, summary_of(run, score),
                 {"Roll and pitch, estimated and true, with the error and its 3-sigma band": picture}, figures,
                 HEADING_REMARK)
    progress.close()
    print(title + "\n\n" + text_table(figures) + f"\n\nreport: {report}")
    return all(figure.within is not False for figure in figures)


def main(arguments=None):
    """Run ``attitude_demo``; return its exit status."""
    parser = argparse.ArgumentParser(prog="attitude_demo", description=__doc__.partition("\n\n")[2],
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bag", type=Path, help="bag with truth (default: the bundled one with turns)")
    parser.add_argument("--rate", type=float, default=RATE, help="times real time (default %(default)g)")
    parser.add_argument("--out", type=Path, default=Path("build/demo"), help="folder (default %(default)s)")
    options = parser.parse_args(arguments)
    progress = Progress(sys.stderr)
    try:
        options.bag = options.bag or bundled_bag("turns")
        if run_demo(options, progress):
            return 0
        print("attitude_demo: a figure is outside its bound", file=sys.stderr)
    except (DemoError, OSError, ValueError) as error:
        progress.close()
        print(f"attitude_demo: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        progress.close()
        return 130
    return 1
