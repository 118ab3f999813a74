"""A truth of another motion, unit or clock, and gravity elsewhere in its world: told where planted, nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import recording as recorded
from toolkit.audit import audit
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.truth import truth_clock, truth_mismatch
from toolkit.datasets.trajectories.belonging import exchanges
from toolkit.geometry import Array, se3, so3_exp
from toolkit.measurements import NS_PER_S
from toolkit.sequence import Sequence, Truth
from toolkit.simulation import faults


def recording(scenario: str, seed: int = 0, duration_s: float = 6.0, varied: bool = False) -> Sequence:
    return recorded(scenario, seed, duration_s, varied)


def truth_of(sequence: Sequence) -> Truth:
    assert sequence.truth is not None
    return sequence.truth


def with_truth(sequence: Sequence, truth: Truth | None) -> Symptom | Undecided | None:
    return truth_mismatch(Evidence(replace(sequence, truth=truth)))


def with_poses(sequence: Sequence, T_world_imu: Array) -> str:
    """Return what is warned of where the truth has these poses."""
    found = with_truth(sequence, replace(truth_of(sequence), T_world_imu=T_world_imu))
    assert isinstance(found, Symptom) and found.warns and found.remedy is None
    return found.detail


@pytest.mark.parametrize("scenario", ["drive", "flight", "flight-realistic", "drive-realistic"])
def test_a_sound_truth_is_not_accused(scenario: str) -> None:
    assert truth_mismatch(Evidence(recording(scenario, 21))) is None


def test_a_truth_of_another_flight_is_reported() -> None:
    """Of the same hall, later: speeds and turns are alike in size, and not in direction."""
    flight, later = recording("flight"), truth_of(recording("flight", 0, 18.0))
    rows = later.t_ns > later.t_ns[0] + 12 * NS_PER_S
    stamps = flight.frames_t_ns[0] + later.t_ns[rows] - later.t_ns[rows][0]
    found = with_truth(flight, Truth(stamps, later.T_world_imu[rows]))
    assert isinstance(found, Symptom)
    assert "the truth's motion is not the camera's" in found.detail


@pytest.mark.parametrize(
    ("rows", "added", "expected"),
    [
        (slice(60, None), 30.0, "jumps 1 time(s), the farthest by 30 m"),
        (slice(20, 21), 1e150, "jumps 2 time(s), the farthest by 1e+150 m"),
        (slice(20, 23), np.nan, "3 of"),
    ],
)
def test_a_truth_that_leaps_or_is_not_finite_is_reported(rows: slice, added: float, expected: str) -> None:
    poses = truth_of(recording("flight")).T_world_imu.copy()
    poses[rows, 2, 3] += added
    assert expected in with_poses(recording("flight"), poses)


@pytest.mark.parametrize(("scenario", "from_to"), [("drive", (0, None)), ("flight", (40, None)), ("flight", (20, 65))])
def test_a_truth_that_stands_still_while_the_camera_moves_is_reported(
    scenario: str, from_to: tuple[int, int | None]
) -> None:
    """As a whole, from a time on, and for a time only, where it repeats a pose exactly."""
    poses = truth_of(recording(scenario)).T_world_imu.copy()
    begin, end = (None if at is None else at * round(len(poses) / 6.0) // 10 for at in from_to)
    poses[begin:end] = poses[begin]
    assert "stands still in" in with_poses(recording(scenario), poses)


def test_a_truth_that_stands_with_the_vehicle_is_not_accused() -> None:
    assert truth_mismatch(Evidence(faults.standstill(recording("drive", 4, 12.0), 8.0, 1))) is None


@pytest.mark.parametrize("words", ["y and z exchanged (positions alone)", "the sign of y changed (positions alone)"])
def test_a_truth_that_runs_backwards_or_in_exchanged_axes_is_reported_with_those(words: str) -> None:
    poses = truth_of(recording("flight")).T_world_imu
    (exchange,) = (one for one in exchanges() if one.description == words)
    assert f"only for a truth with {words}" in with_poses(recording("flight"), exchange.reread(poses))
    backwards = with_poses(recording("drive"), truth_of(recording("drive")).T_world_imu[::-1])
    assert "only for a truth whose poses run backwards" in backwards


def test_a_clock_is_reported_once_either_by_its_offset_or_by_its_pace() -> None:
    sound = recording("flight", 32, 6.0, True)
    late = replace(sound, truth=replace(truth_of(sound), t_ns=truth_of(sound).t_ns + 100_000_000))
    found = [[f.fault for f in audit(s).findings] for s in (faults.truth_clock_rate(sound, 1.04), late)]
    assert [[name for name in names if "truth" in name] for names in found] == [["truth-clock"], ["truth-mismatch"]]


def test_a_truth_without_turns_leaves_its_clock_open() -> None:
    """On a road that goes straight ahead nothing tells the truth's clock."""
    reported = truth_clock(Evidence(faults.standstill(recording("drive", 4, 12.0, True), 8.0, 1)))
    assert isinstance(reported, Undecided) and "too little change of rotation" in reported.why


@pytest.mark.parametrize(
    ("scenario", "gravity_world"), [("flight", (0.0, 0.0, 9.81)), ("drive-imu", (-9.81, 0.0, 0.0))]
)
def test_gravity_that_points_elsewhere_is_set_right(scenario: str, gravity_world: tuple[float, ...]) -> None:
    sound = recording(scenario, 31, 6.0, True)
    assert "gravity-direction" not in {finding.fault for finding in audit(sound).findings}
    outcome = audit(replace(sound, gravity_world=np.array(gravity_world)))
    (finding,) = [finding for finding in outcome.findings if finding.repaired]
    assert (finding.fault, finding.blocking) == ("gravity-direction", False)
    np.testing.assert_allclose(outcome.sequence.gravity_world, sound.gravity_world, atol=1e-12)


def test_gravity_blocks_far_from_all_axes_of_the_world_and_is_not_judged_by_a_truth_in_other_axes() -> None:
    sound = recording("flight", 31, 6.0, True)

    def found(T_world_imu: Array) -> dict[str, str]:
        truth = replace(truth_of(sound), T_world_imu=T_world_imu, v_world=None)
        return {f.fault: f.detail for f in audit(replace(sound, truth=truth, prior=None)).findings}

    tilted = found(se3(so3_exp(np.array([0.25 * np.pi, 0.0, 0.0])), np.zeros(3)) @ truth_of(sound).T_world_imu)
    assert "no axis of the world is near" in tilted["gravity-direction"]
    other_axes = truth_of(sound).T_world_imu @ se3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    assert "gravity-direction" not in found(other_axes)
