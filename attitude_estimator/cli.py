"""estimate_bag: the attitude of a recorded bag, by the same kernels as the node, without DDS.

Messages are taken in recorded order through the node's own time gate and time buffer, so the output bag has
what ``attitude_node`` would have published. Parts of a recording are decoded, estimated and encoded at once.
With ``--smooth`` the whole bag is one part, and each estimate knows what came after it.
"""

import dataclasses
import itertools
import math
import warnings
from functools import partial

import numpy as np

from attitude_estimator.delay import fit_delay
from attitude_estimator.edge import (
    OUTPUT_TYPES,
    AttitudeNodeParams,
    MessageNoise,
    OutputMessages,
    stamp_actions,
    start_with_stored,
)
from attitude_estimator.estimator import ACTION_USE, Estimates
from attitude_estimator.rivals import make_estimator
from attitude_estimator.smoother import check_smoothable, smooth
from inertial.recording import AltitudeSeries, ImuSeries
from nav_ros.altitude_source import AltitudeRefusedError, AltitudeSource
from nav_ros.bag_to_bag import BagEstimator, bags_parser, estimate_bag_to_bag, estimate_bags
from nav_ros.bags import TYPES, BagError, BagWarning, read_recording
from nav_ros.cli import topics_of
from nav_ros.frames import swap_flu_frd
from nav_ros.imu_check import ImuCheck
from nav_ros.messages import (
    ACCEL,
    ACCEL_COVARIANCE,
    GYRO,
    GYRO_COVARIANCE,
    IMU,
    StampedEncoder,
    decode_batch,
)
from nav_ros.time_gate import StampCode, classify_stamps, gate_state

CHECK_RATE = 50.0  # Hz at which samples are looked over for a wrong unit
SUSPECT_SHARE = 0.01  # of samples with a rate beyond gyro_range, from which the unit is in doubt


class AttitudeBagEstimator(BagEstimator):
    """Turns the messages of one bag into those that ``attitude_node`` publishes.

    Parameters
    ----------
    params : AttitudeNodeParams
    bag, topics
        As of a :class:`~nav_ros.bag_to_bag.BagEstimator`.
    smoothed : bool
        The bag is then estimated at once.
    """

    keys, copies, output_types = ("imu", "altitude", "pressure"), ("truth",), OUTPUT_TYPES

    def __init__(self, params, bag, topics, smoothed=False):
        super().__init__(params, bag, topics)
        self._estimator = make_estimator(params)
        if smoothed:
            check_smoothable(params)
            self.part = math.inf
        self._smoothed = smoothed
        self._stored = self.stored_biases()
        if smoothed and self._stored is not None:
            raise ValueError(f"bias_file = {params.bias_file!r}: the smoother finds the biases from both ends")
        self._noise = MessageNoise()
        self._frames = []
        self._faults = self._estimator.faults
        self._gate = gate_state()
        self._messages = OutputMessages(params.mounting_rpy)
        self._check = ImuCheck(self._messages.mounting.up_imu)
        self._altimeter_topic, self._altimeter_type, self._source = None, None, None
        for topic, key in self.inputs.items():
            if key != "imu":
                self._altimeter_topic, self._altimeter_type = topic, TYPES[key]
                self._source = AltitudeSource(TYPES[key])
        if self._source is None and params.altitude_source == "auto":
            warnings.warn(f"{bag.path}: neither {topics['altitude']} nor {topics['pressure']} is there: the IMU alone "
                          f"is used; topics there: {', '.join(sorted(bag.types))}", BagWarning, stacklevel=2)
        self._refused = {}
        self._encoders = {}
        self._slot = -1

    def estimate(self, part):
        """Return what follows from a list of (topic, receive_ns, raw), as such a list."""
        imu = [message for message in part if self.inputs[message.topic] == "imu"]
        batch = decode_batch(IMU, [message.raw for message in imu])
        self.counts["malformed"] += len(batch.malformed)
        codes, stamps = classify_stamps(batch.stamp_ns, self.params, self._gate)
        for code in StampCode:
            if code not in (StampCode.STEP, StampCode.FIRST):
                self.counts[code.name.lower()] += int(np.sum(codes == code))
        series = ImuSeries(stamps, swap_flu_frd(batch.values[:, GYRO]), swap_flu_frd(batch.values[:, ACCEL]))
        actions = stamp_actions(codes)
        self._look_at(batch, stamps)
        self._start_with_stored(stamps[actions == ACTION_USE])
        estimates, fresh = self._run(series, *self._altitudes(part, batch.index), actions)
        self.counts["samples"] += len(estimates)
        self.counts["attitudes"] += int(np.sum(estimates.valid))
        receive_ns = np.array([message.receive_ns for message in imu], np.int64)[batch.index][fresh]
        frame_ids = [batch.frame_id[k] for k in np.flatnonzero(fresh)]
        return self._encode(estimates, receive_ns, frame_ids)

    def _look_at(self, batch, stamps):
        """Judge what is in the messages besides the samples, and whether those are in the right unit."""
        runs = [frame for frame, _ in itertools.groupby(self._frames + batch.frame_id)]
        self.counts["frame_id_empty"] += runs[len(self._frames):].count("")
        self.counts["frame_id_changed"] += max(len(runs) - 1, 0)
        self._frames = runs[-1:]
        if len(stamps) < 2:
            return
        period = max(float(np.median(np.diff(stamps))) * 1e-9, 0.0)
        some = slice(None, None, round(1.0 / (CHECK_RATE * period)) or 1 if period > 0.0 else 1)
        values = batch.values[some]
        for sample in zip(stamps[some].tolist(), values[:, GYRO].tolist(), values[:, ACCEL].tolist(), strict=True):
            self._check.add(*sample)
        # The first message's covariances stand for those of the part.
        if self._noise.take(*(batch.values[0, field].tolist() for field in (GYRO_COVARIANCE, ACCEL_COVARIANCE))):
            self._estimator.params = self._noise.applied(self.params, period)
        self.counts["covariance_invalid"] += len(batch) * self._noise.invalid

    def _start_with_stored(self, stamps):
        if self._stored is not None and len(stamps):
            start_with_stored(self._estimator, self._stored, int(stamps[0]))
            self._stored = None

    def _run(self, imu, altitude, variance, actions):
        if self._smoothed:
            estimates, fresh, self._faults = smooth(imu, altitude, variance, params=self._estimator.params,
                                                    actions=actions)
        else:
            estimates, fresh = self._estimator.run(imu, altitude, variance, actions=actions)
            self._faults = self._estimator.faults
        return estimates, fresh

    @property
    def faults(self):
        """Name -> count of everything that was refused or bridged."""
        counts = {name: count for name, count in self.counts.items() if name not in ("samples", "attitudes")}
        return vars(self._faults) | counts

    def summary(self):
        """Return what came out."""
        return [f"{self.counts['samples']} estimates, "
                f"{self.counts['attitudes'] / self.counts['samples']:.1%} with an attitude"]

    @property
    def suspicions(self):
        """What the values show of a wrong unit or a wrong side up, a list of texts."""
        suspicions = list(self._check.faults.values())
        beyond = vars(self._faults).get("gyro_out_of_range", 0)
        if "gyro_unit" not in self._check.faults and beyond > SUSPECT_SHARE * self.counts["samples"]:
            suspicions.append(f"{beyond} rates are beyond gyro_range = {self.params.gyro_range:g} rad/s: are they in "
                              "deg/s? An Imu has rad/s: multiply by pi/180")
        suspicions += [f"{self.counts[fault]} samples of {self._altimeter_topic} refused: {reason}"
                       for fault, reason in self._refused.items()]
        if self.counts["samples"] and not self.counts["attitudes"]:
            suspicions.append("no sample has an attitude: is this an IMU that feels gravity, in m/s^2?")
        return suspicions

    def _altitudes(self, part, imu_index):
        """Return the altitudes of a part and their variances; arrival counts decoded IMU messages."""
        stamps, values, variances, arrival = [], [], [], []
        received = 0
        raws, places = [], []
        for message in part:
            if self.inputs[message.topic] == "imu":
                received += 1
            else:
                raws.append(message.raw)
                places.append(received)
        if not raws:
            return None, None
        batch = decode_batch(self._altimeter_type, raws)
        self.counts["malformed"] += len(batch.malformed)
        before = np.searchsorted(imu_index, places)
        for place, stamp_ns, fields in zip(batch.index, batch.stamp_ns, batch.values, strict=True):
            if stamp_ns <= 0:
                self.counts["altitude_no_stamp"] += 1
                self._refused.setdefault("altitude_no_stamp", "they have no stamp")
                continue
            try:
                altitude, variance = self._source.convert(fields)
            except AltitudeRefusedError as error:
                self.counts[error.fault] += 1
                self._refused.setdefault(error.fault, str(error))
                continue
            stamps.append(stamp_ns)
            values.append(altitude)
            variances.append(variance)
            arrival.append(before[place])
        series = AltitudeSeries(np.array(stamps, np.int64), np.array(values, float),
                                np.array(arrival, np.int64))
        return series, np.array(variances, float)

    def _encode(self, estimates, receive_ns, frame_ids):
        out = []
        names = sorted(set(frame_ids))
        frames = np.array([names.index(frame) for frame in frame_ids])
        slots = self.params.auxiliary_slot(estimates.stamp_ns)
        auxiliary = np.diff(slots, prepend=self._slot) != 0
        self._slot = slots[-1] if len(slots) else self._slot
        for topic in OUTPUT_TYPES:
            keep = np.ones(len(estimates), bool) if topic == "imu/data" else auxiliary
            if topic == "imu/rpy/filtered":
                keep = keep & estimates.valid
            for frame, name in enumerate(names):
                rows = np.flatnonzero(keep & (frames == frame))
                part = Estimates(estimates.stamp_ns[rows], estimates.rows[rows])
                raws = self._encoder(topic, name).encode_batch(part.stamp_ns,
                                                                     self._messages.values(topic, part))
                out += zip([f"/{topic}"] * len(rows), receive_ns[rows].tolist(), raws, strict=True)
        return out

    def _encoder(self, topic, frame):
        key = topic, frame
        if key not in self._encoders:
            self._encoders[key] = StampedEncoder(OUTPUT_TYPES[topic], *self.params.frames(topic, frame))
        return self._encoders[key]


estimate_bag = partial(estimate_bag_to_bag, AttitudeBagEstimator)
"""Write the estimates of one bag into another; ``smoothed=True`` lets each know the whole bag, held in memory."""


def find_delay(path, params, topics):
    """Return the :class:`~attitude_estimator.delay.DelayFit` of a bag's altimeter; parameters as of `estimate_bag`.

    Raises
    ------
    nav_ros.bags.BagError
        There is no such bag, or no altimeter in it.
    ValueError
        The bag does not show the delay.
    """
    recording = read_recording(path, topics, params.altitude_source)
    if recording.altitude is None:
        raise BagError(f"{path}: no altimeter, so no delay of it")
    codes, stamps = classify_stamps(recording.imu.stamp_ns, params)
    return fit_delay(dataclasses.replace(recording.imu, stamp_ns=stamps), recording.altitude, params,
                     stamp_actions(codes))


def _with_delay(path, params, topics):
    """Return the parameters with the altimeter's delay that a bag shows, and tell it."""
    try:
        fit = find_delay(path, params, topics)
    except ValueError as error:
        warnings.warn(f"{path}: {error}; altitude_delay stays {params.altitude_delay:g} s", BagWarning, stacklevel=2)
        return params
    print(f"{path}: altitude_delay {fit.delay:.3f} s, +-{fit.std:.3f}")
    return dataclasses.replace(params, altitude_delay=fit.delay, altitude_delay_std=fit.std)


def main(arguments=None):
    """Run ``estimate_bag``; return its exit status."""
    return estimate_bags(_parser(), AttitudeNodeParams, _estimate_one, arguments)


def _estimate_one(bag, out, params, options):
    topics = topics_of(options)
    if options.fit_delay:
        params = _with_delay(bag, params, topics)
    return estimate_bag(bag, out, params, topics, options.storage, smoothed=options.smooth)


def _parser():
    parser = bags_parser(
        "estimate_bag", "Write the bag that attitude_node would make of a recording: /imu/data, /imu/rpy/filtered, "
        "/attitude/state, the biases, and a copy of the truth.", "attitude_node", AttitudeBagEstimator)
    parser.add_argument("--smooth", action="store_true",
                        help="estimate each sample from the whole bag, also from what came after it")
    parser.add_argument("--fit-delay", action="store_true",
                        help="find altitude_delay and its spread from each bag, tell and use them")
    return parser
