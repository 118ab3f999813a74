"""Short clean recordings of every kind, and the faults that can be planted in them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest

from toolkit.audit import Audit, audit, fault
from toolkit.geometry import Array, IntArray, se3
from toolkit.measurements import NS_PER_S
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Observations, Sequence, content_digest
from toolkit.simulation import SCENARIOS, simulate

# Most faults show in a hundred frames; of a flight as short a gap of two seconds would leave too little.
LENGTH_S = {"drive": 10.0, "drive-imu": 10.0, "flight": 6.0}


@cache
def clean(scenario: str = "drive", seed: int = 0, duration_s: float | None = None) -> Sequence:
    """Return a simulated recording."""
    length_s = LENGTH_S[scenario] if duration_s is None else duration_s
    return simulate(replace(SCENARIOS[scenario], duration_s=length_s), seed)


@dataclass(frozen=True)
class Plant:
    """A fault planted on purpose: its name, the recording with it, and the count the audit owes."""

    fault: str
    planted: Sequence
    count: int

    @cached_property
    def audited(self) -> Audit:
        """What the audit makes of it."""
        return audit(self.planted)


def with_observations(sequence: Sequence, rows: object = slice(None), **columns: Array | IntArray) -> Sequence:
    """Return the sequence with some columns of its observations exchanged, then cut to the rows."""
    o = sequence.observations
    merged = {"frame": o.frame, "track_id": o.track_id, "uv_px": o.uv_px} | columns
    return replace(sequence, observations=Observations.sorted(*(merged[c][rows] for c in merged)))


def with_samples(sequence: Sequence, rows: object) -> Sequence:
    """Return the sequence with the motion samples of an index, in that order."""
    m = sequence.motion
    kept = {field.name: getattr(m, field.name)[rows] for field in fields(m) if field.name != "pairing"}
    return replace(sequence, motion=replace(m, **kept))


def turned(sequence: Sequence, turn: Array) -> Sequence:
    """Return the sequence with its extrinsic written in other body axes."""
    rig = sequence.rig
    return replace(sequence, rig=replace(rig, T_imu_cam=se3(turn, np.zeros(3)) @ rig.T_imu_cam))


def not_finite(sequence: Sequence) -> Plant:
    uv_px, values = sequence.observations.uv_px.copy(), sequence.motion.values.copy()
    uv_px[100:2100:50, 0] = np.nan
    values[40:100:20, 4] = np.inf
    m = sequence.motion
    names = [field.name for field in fields(m) if field.name not in ("t_ns", "pairing")]
    motion = replace(m, **dict(zip(names, (values[:, :3], values[:, 3:]), strict=True)))
    return Plant("not-finite", with_observations(replace(sequence, motion=motion), uv_px=uv_px), 40 + 3)


def time_order(sequence: Sequence) -> Plant:
    """Swap frames 10 and 11, and repeat samples 5 and 20."""
    swapped = np.arange(sequence.frame_count)
    swapped[[10, 11]] = swapped[[11, 10]]
    planted = with_observations(sequence, frame=swapped[sequence.observations.frame])
    planted = replace(planted, frames_t_ns=sequence.frames_t_ns[swapped])
    samples = np.sort(np.append(np.arange(len(sequence.motion.t_ns)), [5, 20]))
    return Plant("time-order", with_samples(planted, samples), 1 + 2)


def time_gap(sequence: Sequence) -> Plant:
    """Leave a hole of two seconds in the motion samples, a third of the way after the start."""
    t_s = (sequence.motion.t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    begins_s = sequence.duration_s / 3.0
    return Plant("time-gap", with_samples(sequence, (t_s <= begins_s) | (t_s >= begins_s + 2.0)), 1)


def outside_motion(sequence: Sequence) -> Plant:
    """Let the motion samples reach from frame 5 to the last frame but three."""
    t_ns, frames = sequence.motion.t_ns, sequence.frames_t_ns
    first, last = np.searchsorted(t_ns, frames[5], side="right") - 1, np.searchsorted(t_ns, frames[-4])
    rows = np.arange(t_ns.size)
    return Plant("outside-motion", with_samples(sequence, (rows >= first) & (rows <= last)), 5 + 3)


def no_disparity(sequence: Sequence) -> Plant:
    uv_px = sequence.observations.uv_px.copy()
    rows = np.arange(0, len(uv_px), 97)
    uv_px[rows, 1] = uv_px[rows, 0] + np.arange(rows.size) % 3
    return Plant("no-disparity", with_observations(sequence, uv_px=uv_px), rows.size)


STALE = (40, 60, 61, 90)


def stale_frames(sequence: Sequence) -> Plant:
    """Repeat the pixels of the frame before in four frames, two of which follow each other."""
    o = sequence.observations
    uv_px = o.uv_px.copy()
    row = {(k, i): n for n, (k, i) in enumerate(zip(o.frame.tolist(), o.track_id.tolist(), strict=True))}
    for k in STALE:
        for n in np.flatnonzero(o.frame == k):
            before = row.get((k - 1, int(o.track_id[n])))
            if before is not None:
                uv_px[n] = uv_px[before]
    return Plant("stale-frames", with_observations(sequence, uv_px=uv_px), len(STALE))


def returning_tracks(sequence: Sequence) -> Plant:
    """Hide the tracks seen in frames 30 to 33 from frame 31, and every other one of them from frame 32 as well."""
    o = sequence.observations
    present = [set(o.track_id[o.frame == k].tolist()) for k in (30, 31, 32, 33)]
    hidden = np.array(sorted(set.intersection(*present)))
    rows = ~(np.isin(o.track_id, hidden) & (o.frame == 31) | np.isin(o.track_id, hidden[::2]) & (o.frame == 32))
    return Plant("returning-tracks", with_observations(sequence, rows), hidden.size)


def doubled_disparity(sequence: Sequence) -> Plant:
    """Detect only near points in frame 0, and double the disparity of each ever after."""
    o = sequence.observations
    disparities = o.uv_px[:, 0] - o.uv_px[:, 1]
    near = [o.track_id[(o.frame == k) & (disparities > 10.0)] for k in (0, 1)]
    detected = np.intersect1d(*near)
    of_detected = np.isin(o.track_id, detected)
    uv_px = o.uv_px.copy()
    later = of_detected & (o.frame > 0)
    uv_px[later, 1] -= disparities[later]
    kept = of_detected | (o.frame > 0)
    return Plant("doubled-disparity", with_observations(sequence, kept, uv_px=uv_px), detected.size)


def mixed_axes(sequence: Sequence) -> Plant:
    return Plant("mixed-axes", turned(sequence, np.diag([1.0, -1.0, -1.0])), 1)


def extrinsic_translation(sequence: Sequence) -> Plant:
    """Put the camera where inverting a rotation imu -> cam beside the camera's position puts it."""
    T_imu_cam = sequence.rig.T_imu_cam
    wrong = se3(T_imu_cam[:3, :3], -T_imu_cam[:3, :3] @ T_imu_cam[:3, 3])
    return Plant("extrinsic-translation", replace(sequence, rig=replace(sequence.rig, T_imu_cam=wrong)), 1)


def twist_lag(sequence: Sequence) -> Plant:
    """Stamp every twist one sample late, so that it describes the interval before its stamp."""
    m = sequence.motion
    assert isinstance(m, TwistSamples)
    late = np.maximum(np.arange(m.t_ns.size) - 1, 0)
    return Plant("twist-lag", replace(sequence, motion=replace(m, v_mps=m.v_mps[late], w_radps=m.w_radps[late])), 1)


PLANTS: dict[str, Callable[[Sequence], Plant]] = {
    "not-finite": not_finite,
    "time-order": time_order,
    "time-gap": time_gap,
    "outside-motion": outside_motion,
    "no-disparity": no_disparity,
    "stale-frames": stale_frames,
    "returning-tracks": returning_tracks,
    "doubled-disparity": doubled_disparity,
    "mixed-axes": mixed_axes,
    "extrinsic-translation": extrinsic_translation,
    "twist-lag": twist_lag,
}
CASES = [
    (scenario, fault)
    for scenario in ("drive", "drive-imu", "flight")
    for fault in PLANTS
    # An IMU has no velocities to tell a lever arm, and its samples are interpolated, not paired.
    if scenario == "drive" or fault not in ("extrinsic-translation", "twist-lag")
]


@pytest.fixture(scope="session", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def plant(request: pytest.FixtureRequest) -> Plant:
    """Return each fault planted in each kind of recording that can have it."""
    scenario, fault = request.param
    # A lag of the twists shows only where there are turns enough.
    return PLANTS[fault](clean(scenario, duration_s=30.0 if fault == "twist-lag" else None))


def _once(function: Callable[..., Any], content: Callable[[Sequence], str]) -> Callable[..., Any]:
    """Return a function of a sequence, and of what follows from it, that remembers what came of the same content."""
    kept: dict[str, Any] = {}

    def remembered(sequence: Sequence, *derived: Any) -> Any:
        key = content(sequence)
        if key not in kept:
            kept[key] = function(sequence, *derived)
        return kept[key]

    return remembered


def _tracks(sequence: Sequence) -> str:
    return content_digest((sequence.observations, sequence.frames_t_ns, sequence.rig))


def _tracks_and_truth(sequence: Sequence) -> str:
    seen = (sequence.observations, sequence.frames_t_ns, sequence.rig)
    return content_digest((*seen, sequence.truth, sequence.motion_kind))


@pytest.fixture(scope="package", autouse=True)
def _derived_once() -> Iterator[None]:
    """Derive what several faults look at once of the same tracks, or of the same recording, for all tests of a worker.

    Most faults are planted in few recordings, many of them beside the tracks, and are audited more than once.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in ("camera_motion", "step_correlation"):
            patch.setattr(fault, name, _once(getattr(fault, name), _tracks))
        for name in ("agreement", "self_calibration"):
            patch.setattr(fault, name, _once(getattr(fault, name), Sequence.content_hash))
        patch.setattr(fault, "truth_clock", _once(fault.truth_clock, _tracks_and_truth))
        yield


@pytest.fixture
def clean_recording() -> Callable[..., Sequence]:
    """Return the maker of clean recordings: scenario, seed, length."""
    return clean


@pytest.fixture
def planted() -> Callable[[str, Sequence], Sequence]:
    """Return what plants a fault, by name, in a recording."""
    return lambda fault, sequence: PLANTS[fault](sequence).planted
