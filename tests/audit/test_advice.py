"""Whoever changes a recording as a finding of the audit says has none of that kind (3 s)."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.advice import TOOLKIT, advice_in, is_followed
from tests.audit.conftest import with_observations
from tests.audit.test_fault_table import normalised, one_camera
from tests.audit.test_truth import recording, truth_of
from toolkit.audit import FAULTS, name_of
from toolkit.audit.fault import Evidence, Symptom
from toolkit.geometry import Array
from toolkit.sequence import Sequence, Truth
from toolkit.simulation import faults

# A step makes another recording of one; what follows an advice has the words of the finding besides.
Plant, Follow = Callable[[Sequence], Sequence], Callable[[Sequence, str], Sequence]
FILLED = slice(0, None, 4)


def poses(change: Callable[[Array], Array]) -> Plant:
    """Return what changes the truth's poses (N, 4, 4)."""
    return lambda s: replace(s, truth=replace(truth_of(s), T_world_imu=change(truth_of(s).T_world_imu.copy())))


def filled(columns: list[int], value: float) -> Plant:
    def plant(sequence: Sequence) -> Sequence:
        uv_px = sequence.observations.uv_px.copy()
        uv_px[FILLED, columns] = value
        return with_observations(sequence, uv_px=uv_px)

    return plant


def in_pixels(sequence: Sequence, _: str) -> Sequence:
    rig = sequence.rig
    f_px, c_px = np.array([rig.fx_px, rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cx_px, rig.cy_px])
    return with_observations(sequence, uv_px=sequence.observations.uv_px * f_px + c_px)


def left_alone(sequence: Sequence, _: str) -> Sequence:
    uv_px = sequence.observations.uv_px.copy()
    uv_px[uv_px[:, 1] == uv_px[:, 0], 1] = np.nan
    uv_px[uv_px[:, 1] < 0.0, 1] = np.nan
    return with_observations(sequence, uv_px=uv_px)


def without_rows(sequence: Sequence, _: str) -> Sequence:
    return with_observations(sequence, (sequence.observations.uv_px != 0.0).any(axis=1))


def kept_poses(sequence: Sequence, kept: Array) -> Sequence:
    """Return a recording with some of the true poses."""
    true = truth_of(sequence)
    return replace(sequence, truth=Truth(true.t_ns[kept], true.T_world_imu[kept]))


def finite(sequence: Sequence, _: str) -> Sequence:
    return kept_poses(sequence, np.isfinite(truth_of(sequence).T_world_imu).all(axis=(1, 2)))


def without_truth(sequence: Sequence, _: str) -> Sequence:
    return replace(sequence, truth=None)


def leap(poses: Array) -> Array:
    poses[60:, 2, 3] += 30.0
    return poses


def lost(poses: Array) -> Array:
    poses[20:23, 2, 3] = np.nan
    return poses


def still(poses: Array) -> Array:
    poses[:] = poses[0]
    return poses


def restamped(sequence: Sequence, words: str) -> Sequence:
    """Shift the truth's stamps by what is told."""
    told = re.search(r"shifted by ([+-]?\d+) \+-", words)
    assert told is not None
    true = truth_of(sequence)
    return replace(sequence, truth=replace(true, t_ns=true.t_ns + int(told[1]) * 1_000_000))


def paced(sequence: Sequence, words: str) -> Sequence:
    """Have the truth's time pass as fast as the frames', where it is told to pass so many times as fast."""
    told = re.search(r"time passes ([\d.]+) \+-", words)
    assert told is not None
    true = truth_of(sequence)
    since_ns = np.rint((true.t_ns - true.t_ns[0]) / float(told[1])).astype(np.int64)
    return replace(sequence, truth=replace(true, t_ns=true.t_ns[0] + since_ns))


def late(sequence: Sequence) -> Sequence:
    return replace(sequence, truth=replace(truth_of(sequence), t_ns=truth_of(sequence).t_ns + 100_000_000))


BACKWARDS = poses(lambda T_world_imu: T_world_imu[::-1])
ROWS: list[tuple[str, Plant, str, Follow]] = [
    ("drive", lambda s: normalised(s, 1.0, 0), "write fx_px u + cx_px and fy_px v + cy_px for them", in_pixels),
    ("drive", lambda s: one_camera(s, 1.0, 0), "correct the file, or leave uR empty", left_alone),
    ("drive", filled([1], -1.0), "leave uR empty where there is none", left_alone),
    ("drive", filled([0, 1, 2], 0.0), "and leave their rows out of a table", without_rows),
    ("drive", BACKWARDS, "write them in the order of their stamps", lambda s, _: BACKWARDS(s)),
    ("flight", poses(lost), "leave them out of the file", finite),
    ("flight", poses(leap), "cut it there", lambda s, _: kept_poses(s, np.arange(60))),
    ("flight", poses(still), "leave it out", without_truth),
    ("flight", lambda s: faults.unwritten_orientations(s, 1.0, 0), "or leave the truth out", without_truth),
    ("flight", late, "stamp both by one clock: every position error", restamped),
    ("flight", lambda s: faults.truth_clock_rate(s, 1.04, 0), "stamp both by one clock: position errors", paced),
]
# What is to be mended where the recording is made, so that what is then read is the sound one.
AT_THE_SOURCE = re.compile(
    r"^(check|correct (it|them|K|the (file|stamps|recording))|choose one|cut (off|the recording)|do not"
    r"|give them the same|record the|run backwards, jump|stamp (both by one clock, (in|or)|rates|them when)"
    r"|state the densities|use a sensor|write (all the digits|them with all|the truth in the axes))"
)


CHECKS = {"intrinsics", "swapped-coordinates", "no-disparity", "left-only", "truth-mismatch", "truth-clock"}


def told_of(sequence: Sequence) -> str:
    """Return what the checks that give these advices say of a recording."""
    evidence = Evidence(sequence)
    found = {name_of(check): check(evidence) for check in FAULTS if name_of(check) in CHECKS}
    return " ".join(f"{one.detail}; {one.treatment}" for one in found.values() if isinstance(one, Symptom))


def test_every_advice_of_the_audit_is_followed_or_is_for_where_it_was_recorded() -> None:
    told = {one for one in advice_in((TOOLKIT / "audit").glob("*.py")) if not AT_THE_SOURCE.match(one)}
    assert not [one for one in told if not is_followed(one, [advice for _, _, advice, _ in ROWS])]


@pytest.mark.parametrize(("scenario", "plant", "advice", "follow"), ROWS, ids=[row[2] for row in ROWS])
def test_who_follows_the_audit_has_no_such_finding(scenario: str, plant: Plant, advice: str, follow: Follow) -> None:
    with np.errstate(all="ignore"):
        planted = plant(recording(scenario))
        told = told_of(planted)
        assert advice in told
        assert advice not in told_of(follow(planted, told))
