"""What estimates cost, beside other filters and beside a node that does nothing, in one run.

``make bench``, or ``python -m studies.bench kernels | starts | nodes | offline | accuracy``. Times of a shared machine
drift, so what is compared is measured in turn, several times, and the least times and their ratio are told. Writes
build/bench/<part>.json.
"""

import argparse
import contextlib
import json
import sys
from pathlib import Path

import numpy as np

from attitude_estimator.estimator import AttitudeEstimator
from attitude_estimator.params import AttitudeParams
from inertial.simulator import simulate
from studies.bench_accuracy import bench_accuracy
from studies.bench_node import bench_nodes, bench_offline, bench_starts
from studies.timing import print_table, times_in_turn

OUT = Path("build/bench")
KERNEL_SECONDS = 60.0  # of simulated flight


def bench_kernels():
    """Time a sample of each filter: through a whole recording, and called from Python one by one."""
    recording = simulate("turn", duration=KERNEL_SECONDS, imu_rate=200.0)
    imu, n = recording.imu, len(recording.imu)
    gyro, accel = np.ascontiguousarray(imu.gyro_b), np.ascontiguousarray(imu.accel_b)
    samples = list(zip(imu.stamp_ns.tolist(), gyro, accel, strict=True))
    batch, calls = {}, {}
    for name in ("dcm_row", "dcm_row5"):
        params = AttitudeParams(estimator=name)
        batch[name] = lambda params=params: AttitudeEstimator(params).run(imu, recording.altitude)
        calls[name] = _per_call(AttitudeEstimator(params).add_imu, samples)
    _add_peers(batch, calls, gyro, accel)
    result = {"batch_us": times_in_turn(batch, n), "call_us": times_in_turn(calls, n)}
    for kind in result:
        print_table(f"{kind.split('_')[0]}: microseconds per sample", result[kind], "vqf")
    return result


def _per_call(call, samples):
    def run():
        last = samples[-1][0]
        for stamp, w, f in samples:
            call(stamp + run.offset, w, f)
        run.offset += last - samples[0][0] + 5_000_000
    run.offset = 0
    return run


def _add_peers(batch, calls, gyro, accel):
    """The peers take FLU; their cost does not depend on the axes."""
    rows = list(zip(gyro, accel, strict=True))
    with contextlib.suppress(ImportError):
        from vqf import VQF
        batch["vqf"] = lambda: VQF(0.005).updateBatch(gyro, accel)
        calls["vqf"] = lambda: _each(VQF(0.005).update, rows)
    with contextlib.suppress(ImportError):
        from imufusion import Ahrs
        calls["imufusion"] = lambda: _each(Ahrs().update_no_magnetometer, rows)
    with contextlib.suppress(ImportError):
        from ahrs.filters import EKF, Madgwick, Mahony
        few = slice(0, 2000)
        for name, peer in (("ahrs Madgwick", Madgwick), ("ahrs Mahony", Mahony), ("ahrs EKF", EKF)):
            batch[name] = lambda peer=peer: peer(gyr=gyro[few], acc=accel[few], frequency=200.0)
            batch[name].samples = 2000


def _each(update, rows):
    for w, f in rows:
        update(w, f)


PARTS = {"kernels": bench_kernels, "starts": bench_starts, "nodes": bench_nodes, "offline": bench_offline,
         "accuracy": bench_accuracy}


def main(arguments=None):
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    options = parser.parse_args(arguments)
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part {', '.join(sorted(unknown))}: there are {', '.join(PARTS)}")
    OUT.mkdir(parents=True, exist_ok=True)
    for part in options.parts or PARTS:
        (OUT / f"{part}.json").write_text(json.dumps(PARTS[part](), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
