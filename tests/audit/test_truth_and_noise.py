"""A truth of another motion or scale, and an IMU's noise that its samples refute: told where planted, nowhere else."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.samples import overstated_noise
from toolkit.audit.truth import truth_mismatch
from toolkit.datasets.trajectories.exchanged_axes import exchanges
from toolkit.measurements import NS_PER_S, ImuNoise
from toolkit.sequence import Sequence, Truth
from toolkit.simulation import SCENARIOS, faults, simulate

DURATION_S = 6.0


def simulated(scenario: str, seed: int = 0) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=DURATION_S), seed)


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return simulated("drive")


@pytest.fixture(scope="module")
def flight() -> Sequence:
    return simulated("flight")


def with_truth(sequence: Sequence, truth: Truth | None) -> Symptom | Undecided | None:
    return truth_mismatch(Evidence(replace(sequence, truth=truth)))


def truth_of(sequence: Sequence) -> Truth:
    assert sequence.truth is not None
    return sequence.truth


@pytest.mark.parametrize("scenario", ["drive", "flight", "flight-realistic", "drive-realistic"])
@pytest.mark.parametrize("seed", [21, 22])
def test_a_sound_truth_and_a_sound_noise_are_not_accused(scenario: str, seed: int) -> None:
    evidence = Evidence(simulated(scenario, seed))
    assert truth_mismatch(evidence) is None
    assert overstated_noise(evidence) is None


@pytest.mark.parametrize(("metres", "unit"), [(0.3048, "feet"), (0.9144, "yards"), (0.0254, "inches")])
def test_a_truth_in_another_unit_is_named_and_not_taken_for_another_motion(
    drive: Sequence, metres: float, unit: str
) -> None:
    found = with_truth(drive, truth_of(faults.truth_unit(drive, 1.0 / metres)))
    assert isinstance(found, Symptom)
    assert f"times the truth's, as of one in {unit}" in found.detail


@pytest.mark.parametrize("scale", [0.8, 1.25, 2.0])
@pytest.mark.parametrize("recording", ["drive", "flight"])
def test_a_wrong_baseline_is_reported_with_its_size(
    recording: str, scale: float, request: pytest.FixtureRequest
) -> None:
    sound: Sequence = request.getfixturevalue(recording)
    wrong = replace(sound, rig=replace(sound.rig, baseline_m=scale * sound.rig.baseline_m))
    found = truth_mismatch(Evidence(wrong))
    assert isinstance(found, Symptom)
    assert found.warns and found.remedy is None
    reported = float(found.detail.split("steps are ")[1].split()[0])
    # what creeping and quantised disparities make of vision's scale on sound flights
    assert reported == pytest.approx(scale, rel=0.03)


def test_a_truth_that_runs_backwards_is_reported(drive: Sequence) -> None:
    truth = truth_of(drive)
    found = with_truth(drive, Truth(truth.t_ns, truth.T_world_imu[::-1]))
    assert isinstance(found, Symptom)
    assert "only for a truth whose poses run backwards" in found.detail


def test_a_truth_of_another_flight_is_reported(flight: Sequence) -> None:
    """Of the same hall, later: speeds and turns are alike in size, and not in direction."""
    later = truth_of(simulate(replace(SCENARIOS["flight"], duration_s=3.0 * DURATION_S), 0))
    rows = later.t_ns > later.t_ns[0] + 2 * DURATION_S * NS_PER_S
    poses, frames_t_ns = later.T_world_imu[rows], flight.frames_t_ns
    stamps = frames_t_ns[0] + later.t_ns[rows] - later.t_ns[rows][0]
    found = with_truth(flight, Truth(stamps, poses))
    assert isinstance(found, Symptom)
    assert "the truth's motion is not the camera's" in found.detail


@pytest.mark.parametrize("late_s", [0.05, -0.2, 0.5])
@pytest.mark.parametrize("scenario", ["flight", "drive", "drive-imu"])
def test_a_truth_by_another_clock_is_reported_with_its_offset(scenario: str, late_s: float) -> None:
    sequence = simulate(replace(SCENARIOS[scenario], duration_s=12.0), 5)
    truth = truth_of(sequence)
    late = replace(truth, t_ns=truth.t_ns + round(late_s * NS_PER_S))
    symptom = with_truth(sequence, late)
    assert isinstance(symptom, Symptom)
    assert symptom.warns
    match = re.search(r"the truth's stamps are shifted by (\S+) \+- (\S+) ms", symptom.detail)
    assert match is not None
    # Printed in whole milliseconds, with an error of less than one as 0.
    assert float(match[1]) == pytest.approx(-1e3 * late_s, abs=4.0 * float(match[2]) + 2.0)


@pytest.mark.parametrize("recording", ["drive", "flight"])
def test_a_truth_that_leaps_or_is_not_finite_is_reported(recording: str, request: pytest.FixtureRequest) -> None:
    sequence = request.getfixturevalue(recording)
    truth = truth_of(sequence)
    for rows, added, expected in (
        (slice(len(truth.t_ns) // 2, None), 30.0, "jumps 1 time(s), the farthest by 30 m"),
        (slice(20, 21), 1e150, "jumps 2 time(s), the farthest by 1e+150 m"),
        (slice(20, 23), np.nan, "3 of"),
    ):
        T_world_imu = truth.T_world_imu.copy()
        T_world_imu[rows, 2, 3] += added
        symptom = with_truth(sequence, replace(truth, T_world_imu=T_world_imu))
        assert isinstance(symptom, Symptom)
        assert symptom.warns
        assert expected in symptom.detail


@pytest.mark.parametrize("recording", ["drive", "flight"])
@pytest.mark.parametrize("from_to", [(0, None), (40, None), (20, 65)])
def test_a_truth_that_stands_still_while_the_camera_moves_is_reported(
    recording: str, from_to: tuple[int, int | None], request: pytest.FixtureRequest
) -> None:
    """As a whole, from a time on, and for a time only, where it repeats a pose exactly."""
    sequence = request.getfixturevalue(recording)
    truth, poses = truth_of(sequence), truth_of(sequence).T_world_imu.copy()
    per_s = round(len(poses) / DURATION_S)
    begin, end = (None if at is None else at * per_s // 10 for at in from_to)
    poses[begin:end] = poses[begin]
    found = with_truth(sequence, replace(truth, T_world_imu=poses))
    assert isinstance(found, Symptom)
    assert found.warns
    assert "stands still in" in found.detail


def test_a_truth_that_stands_with_the_vehicle_is_not_accused() -> None:
    sequence = faults.standstill(simulate(replace(SCENARIOS["drive"], duration_s=12.0), 4), 8.0, 1)
    assert truth_mismatch(Evidence(sequence)) is None


@pytest.mark.parametrize("words", ["y and z exchanged (positions alone)", "the sign of y changed (positions alone)"])
def test_a_truth_in_exchanged_axes_is_reported_with_those(flight: Sequence, words: str) -> None:
    truth = truth_of(flight)
    (exchange,) = (one for one in exchanges() if one.description == words)
    found = with_truth(flight, replace(truth, T_world_imu=exchange.reread(truth.T_world_imu)))
    assert isinstance(found, Symptom)
    assert f"only for a truth with {words}" in found.detail


def test_a_truth_of_other_times_or_none_is_not_checked(drive: Sequence) -> None:
    truth = truth_of(drive)
    assert with_truth(drive, None) is None
    elsewhen = Truth(truth.t_ns + 1000 * NS_PER_S, truth.T_world_imu)
    assert isinstance(with_truth(drive, elsewhen), Undecided)


@pytest.mark.parametrize(
    ("name", "factor"), [("accel_noise_density", 1e3), ("gyro_noise_density", 1e3), ("accel_random_walk", 1e4)]
)
def test_a_thousand_times_the_noise_of_an_imu_is_reported_by_its_name(
    flight: Sequence, name: str, factor: float
) -> None:
    """A walk must be larger still: the motion of a flight hides it."""
    noise = flight.noise
    assert isinstance(noise, ImuNoise)
    found = overstated_noise(Evidence(replace(flight, noise=replace(noise, **{name: factor * getattr(noise, name)}))))
    assert found is not None
    assert found.warns
    assert name in found.detail


def test_noise_that_allows_for_vibration_is_not_accused(flight: Sequence) -> None:
    assert overstated_noise(Evidence(replace(flight, noise=flight.noise.scaled(10.0)))) is None
