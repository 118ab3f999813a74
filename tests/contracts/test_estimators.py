"""What every estimator promises, whoever wrote it: a new file in an announced package is tested here unasked."""

import ast
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from toolkit import runner
from toolkit import verify as promises
from toolkit.answers import Run
from toolkit.errors import DataError, EstimatorError
from toolkit.estimate import Trajectory
from toolkit.estimator import Build
from toolkit.geometry import se3_inverse, se3_log
from toolkit.models.stereo import triangulate_world
from toolkit.progress import SILENT
from toolkit.registry import discover, find
from toolkit.sequence import Sequence
from toolkit.simulation import faults, noise_free, simulate
from toolkit.verify import UNAVAILABLE, digests_at, watch

SCENARIOS = {scenario.name: scenario for scenario in promises.SCENARIOS}
SEED = 4
# What a broken measurement does shows at once: the recordings of these tests are so short.
FRAMES_WITH_NAN = 12
# Exact IMU samples at 1 kHz are integrated by the midpoint rule, which errs by dt^2 / 12 times the change of the jerk:
# up to 1e-6 m and 1e-7 rad here. Twists are exact: only rounding is left, and the same limit is generous.
NOISE_FREE_M, NOISE_FREE_RAD = {"twist": 1e-6, "imu": 5e-6}, 1e-6

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)
# Where the kind of motion samples makes no difference to what is asked.
both_kinds = pytest.mark.parametrize("scenario", ["drive", "flight"])


@pytest.fixture(scope="module", params=sorted(discover()))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def build(name: str) -> Build:
    try:
        return find(name).load()
    except EstimatorError as unavailable:
        pytest.skip(str(unavailable))


@cache
def recording(scenario: str) -> Sequence:
    return simulate(SCENARIOS[scenario], SEED)


@cache
def exact_recording(scenario: str) -> Sequence:
    return simulate(noise_free(SCENARIOS[scenario]), SEED)


def run_on(name: str, build: Build, sequence: Sequence) -> Run:
    return runner.run(name, build, sequence, sequence.prior, SILENT)


@every_scenario
def test_every_run_keeps_its_promises(build: Build, scenario: str) -> None:
    """What vislam verify asks of a run: causal, deterministic, finite, sound, and it changes nothing it was given."""
    run = watch(build, recording(scenario))
    asked = [*(broken for broken, _ in promises.OF_A_RUN.values()), promises.unsound_covariance]
    assert [why for broken in asked if (why := broken(run))] == []


def assert_close_to_truth(trajectory: Trajectory, sequence: Sequence) -> None:
    error = se3_log(se3_inverse(sequence.truth.T_world_imu) @ trajectory.T_world_imu)
    assert np.linalg.norm(error[:, 3:], axis=1).max() < NOISE_FREE_M[sequence.motion_kind]
    assert np.linalg.norm(error[:, :3], axis=1).max() < NOISE_FREE_RAD


@every_scenario
def test_without_noise_it_recovers_the_truth_and_its_landmarks_are_where_they_are(name, build, scenario) -> None:
    sequence = exact_recording(scenario)
    run = run_on(name, build, sequence)
    assert run.status == "ok"
    for trajectory in (run.causal, run.final):
        if trajectory is not None:
            assert_close_to_truth(trajectory, sequence)
    landmarks, visible, truth = run.landmarks, sequence.visible, sequence.truth
    assert (np.diff(landmarks.track_ids) > 0).all()
    assert np.isin(landmarks.track_ids, visible.track_id).all()
    _, first = np.unique(visible.track_id, return_index=True)
    points = triangulate_world(visible.uv_px[first], truth.T_world_imu[visible.frame[first]], sequence.rig)
    expected = points[np.searchsorted(visible.track_id[first], landmarks.track_ids)]
    # A landmark is at most 40 m from its pose: its angle's error comes on top of the position's.
    limit_m = NOISE_FREE_M[sequence.motion_kind] + 40.0 * NOISE_FREE_RAD
    assert np.abs(landmarks.points_world - expected).max(initial=0.0) < limit_m


@both_kinds
@pytest.mark.parametrize(("frames", "sees"), [(20, False), (2, True)], ids=["without vision", "with two frames"])
def test_it_goes_on_with_little(name: str, build: Build, scenario: str, frames: int, *, sees: bool) -> None:
    whole = recording(scenario).truncated(frames)
    sequence = whole if sees else replace(whole, observations=whole.observations.select(whole.observations.frame < 0))
    run = run_on(name, build, sequence)
    assert run.status == "ok", run.log
    assert len(run.final) == frames


def test_without_noise_and_a_third_of_the_right_images_it_recovers_the_truth(name: str, build: Build) -> None:
    sequence = faults.missing_right(exact_recording("drive"), 1.0 / 3.0, SEED)
    run = run_on(name, build, sequence)
    assert run.status == "ok", run.log
    assert_close_to_truth(run.final, sequence)


def with_nan(sequence: Sequence, where: str) -> Sequence:
    if where == "observation":
        uv_px = sequence.observations.uv_px.copy()
        uv_px[len(uv_px) // 2, 0] = np.nan
        return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))
    field = "v_mps" if sequence.motion_kind == "twist" else "accel_mps2"
    samples = getattr(sequence.motion, field).copy()
    samples[np.searchsorted(sequence.motion.t_ns, sequence.frames_t_ns[sequence.frame_count // 2]), 1] = np.nan
    return replace(sequence, motion=replace(sequence.motion, **{field: samples}))


@both_kinds
@pytest.mark.parametrize("where", ["observation", "motion sample"])
def test_a_measurement_that_is_not_a_number_reaches_no_estimator(scenario: str, where: str) -> None:
    with pytest.raises(DataError, match=f"{where} .*not finite"):
        run_on(
            "none",
            lambda _: pytest.fail("it was built"),
            with_nan(recording(scenario).truncated(FRAMES_WITH_NAN), where),
        )


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("scenario", "field"), [("drive", "T_world_imu"), ("flight", "T_world_imu"), ("flight", "cov")]
)
def test_a_start_that_is_not_a_number_never_ends_ok(name, build, scenario, field) -> None:
    """The prior does not pass through packets(): here the estimator and the runner have to tell."""
    sequence = recording(scenario).truncated(FRAMES_WITH_NAN)
    bad = getattr(sequence.prior, field).copy()
    bad[0, 0] = np.nan
    run = run_on(name, build, replace(sequence, prior=replace(sequence.prior, **{field: bad})))
    if field == "cov" and run.final is not None and np.isfinite(run.final.T_world_imu).all():
        # Who does not weigh anything by the prior's covariance may go on, but not state it as its own.
        assert run.final.cov is None or not np.isfinite(run.final.cov).all() or run.status != "ok"
    else:
        assert run.status != "ok"
        assert run.log


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@both_kinds
def test_a_packet_that_is_not_a_number_never_ends_in_a_finite_lie(name, build, scenario, monkeypatch) -> None:
    """With the gatekeeper asleep: a NaN in the motion must show, whatever the estimator does with it."""
    monkeypatch.setattr("toolkit.sequence.check_runnable", lambda sequence: None)
    run = run_on(name, build, with_nan(recording(scenario).truncated(FRAMES_WITH_NAN), "motion sample"))
    assert run.status != "ok"


def test_every_estimator_has_a_one_line_summary(name: str) -> None:
    summary = find(name).summary()
    assert 20 <= len(summary) <= 120
    assert summary.endswith((".", ")"))


@pytest.fixture(scope="module")
def digests(made_once: Callable[[str, Callable[[], list[dict[str, str]]]], list[dict[str, str]]]):
    """The number of threads is settled when the numeric libraries are loaded: each number has a process of its own."""
    return made_once("digests", lambda: [digests_at(threads, tuple(discover())) for threads in (1, 2)])


@both_kinds
def test_one_thread_and_two_say_the_same_bits(name: str, scenario: str, digests: list[dict[str, str]]) -> None:
    one, two = (reported[f"{name} on {scenario}"] for reported in digests)
    if one == two == UNAVAILABLE:
        pytest.skip(f"{name} is unavailable")
    assert one == two


def test_no_text_of_the_toolkit_is_an_estimators_name() -> None:
    """The toolkit finds estimators and names none. An example in a help text is a sentence, not a name."""
    estimators, toolkit = discover().keys(), Path(__file__).parents[2] / "toolkit"
    for path in sorted(toolkit.rglob("*.py")):
        constants = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant))
        assert not estimators & {node.value for node in constants if isinstance(node.value, str)}, path
