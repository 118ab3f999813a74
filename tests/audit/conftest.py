"""Short clean recordings of every kind, and the faults that can be planted in them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import pytest

from toolkit.audit import Audit, audit
from toolkit.geometry import Array, IntArray, se3
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

# Long enough for faults that show in the second half alone, or beside turns.
LONGER_S = {"drive": 12.0, "drive-imu": 12.0, "flight": 6.0}


@cache
def recording(scenario: str, seed: int = 1, duration_s: float | None = None, varied: bool = False) -> Sequence:
    """Return a simulated recording of any scenario."""
    return simulate(replace(SCENARIOS[scenario], duration_s=duration_s or LONGER_S[scenario], varied=varied), seed)


def clean_recording(scenario: str = "drive", seed: int = 0, duration_s: float | None = None) -> Sequence:
    """Return a short one: most faults show in a hundred frames; of a flight as short a gap would leave too little."""
    return recording(scenario, seed, duration_s or min(LONGER_S[scenario], 10.0))


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


def not_finite(sequence: Sequence) -> Plant:
    uv_px, values = sequence.observations.uv_px.copy(), sequence.motion.values.copy()
    uv_px[100:2100:50, 0] = np.nan
    values[40:100:20, 4] = np.inf
    motion = sequence.motion.of(sequence.motion.t_ns, values)
    return Plant("not-finite", with_observations(replace(sequence, motion=motion), uv_px=uv_px), 40 + 3)


def time_order(sequence: Sequence) -> Plant:
    """Swap frames 10 and 11, and repeat samples 5 and 20."""
    swapped = np.arange(sequence.frame_count)
    swapped[[10, 11]] = swapped[[11, 10]]
    planted = with_observations(sequence, frame=swapped[sequence.observations.frame])
    planted = replace(planted, frames_t_ns=sequence.frames_t_ns[swapped])
    samples = np.sort(np.append(np.arange(len(sequence.motion.t_ns)), [5, 20]))
    return Plant("time-order", planted.with_samples(samples), 1 + 2)


def time_gap(sequence: Sequence) -> Plant:
    """Leave a hole of two seconds in the motion samples, in the first half."""
    return Plant("time-gap", faults.motion_gap(sequence, 2.0, seed=3), 1)


def outside_motion(sequence: Sequence) -> Plant:
    """Let the motion samples reach from frame 5 to the last frame but three."""
    t_ns, frames = sequence.motion.t_ns, sequence.frames_t_ns
    first, last = np.searchsorted(t_ns, frames[5], side="right") - 1, np.searchsorted(t_ns, frames[-4])
    return Plant("outside-motion", sequence.with_samples(np.arange(first, last + 1)), 5 + 3)


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
    """Write the extrinsic in other axes of the body."""
    T_imu_cam = se3(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ sequence.rig.T_imu_cam
    return Plant("mixed-axes", replace(sequence, rig=replace(sequence.rig, T_imu_cam=T_imu_cam)), 1)


def extrinsic_translation(sequence: Sequence) -> Plant:
    """Put the camera where inverting a rotation imu -> cam beside the camera's position puts it."""
    T_imu_cam = sequence.rig.T_imu_cam
    wrong = se3(T_imu_cam[:3, :3], -T_imu_cam[:3, :3] @ T_imu_cam[:3, 3])
    return Plant("extrinsic-translation", replace(sequence, rig=replace(sequence.rig, T_imu_cam=wrong)), 1)


def twist_lag(sequence: Sequence) -> Plant:
    """Stamp every twist one sample late, so that it describes the interval before its stamp."""
    m = sequence.motion
    late = np.maximum(np.arange(m.t_ns.size) - 1, 0)
    return Plant("twist-lag", replace(sequence, motion=m.of(m.t_ns, m.values[late])), 1)


_ALL = (
    not_finite,
    time_order,
    time_gap,
    outside_motion,
    no_disparity,
    stale_frames,
    returning_tracks,
    doubled_disparity,
    mixed_axes,
    extrinsic_translation,
    twist_lag,
)
PLANTS: dict[str, Callable[[Sequence], Plant]] = {plant.__name__.replace("_", "-"): plant for plant in _ALL}
CASES = [
    (scenario, name)
    for scenario in ("drive", "drive-imu", "flight")
    for name in PLANTS
    # An IMU has no velocities to tell a lever arm, and its samples are interpolated, not paired.
    if scenario == "drive" or name not in ("extrinsic-translation", "twist-lag")
]


@pytest.fixture(scope="session", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def plant(request: pytest.FixtureRequest) -> Plant:
    """Return each fault planted in each kind of recording that can have it."""
    scenario, name = request.param
    # A lag of the twists shows only where there are turns enough.
    return PLANTS[name](clean_recording(scenario, duration_s=30.0 if name == "twist-lag" else None))


def planted(name: str, sequence: Sequence) -> Sequence:
    """Plant a fault, by its name, in a recording."""
    return PLANTS[name](sequence).planted


def details(outcome: Audit) -> dict[str, str]:
    return {finding.fault: finding.detail for finding in outcome.findings}


def unrepaired(sequence: Sequence) -> dict[str, str]:
    return {finding.fault: finding.detail for finding in audit(sequence).findings if not finding.repaired}


def with_values(sequence: Sequence, change: Callable[[Array], Array]) -> Sequence:
    """Return a recording whose motion samples have other values (S, 6)."""
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, change(sequence.motion.values.copy())))


def with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))
