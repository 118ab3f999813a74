"""The Cramér-Rao bound: two ways to it agree, the efficient estimate attains it, what is lost against it is found."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metrics.conftest import make_run
from toolkit.estimate import Trajectory
from toolkit.geometry import se3_exp, se3_inverse
from toolkit.initialization import start_from_measurements
from toolkit.metrics import describe, metrics_called, requests_of, score_run
from toolkit.metrics.parts.cramer_rao import efficient
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, faults, simulate

SHORT = {
    s.name: replace(s, duration_s=duration_s, camera=replace(s.camera, max_tracks=40))
    for s, duration_s in ((DRIVE, 3.0), (DRIVE_IMU, 2.0), (FLIGHT, 1.5))
}
KEYS = [metric.key for metric in metrics_called(["bound"])]


@pytest.fixture(scope="module", params=[*SHORT, "left-only"])
def sequence(request):
    if request.param == "left-only":
        return faults.missing_right(simulate(SHORT["drive"], 3), 0.3, 3)
    return simulate(SHORT[request.param], 3)


def test_at_the_last_frame_the_causal_bound_is_the_final_one(sequence):
    """The one is a forward filter in NumPy, the other GTSAM's elimination of the whole graph."""
    causal, final = efficient(sequence, "causal"), efficient(sequence, "final")
    sigmas = np.sqrt(np.diag(final.covs[-1]))
    # GTSAM's Jacobians are taken at the residuals' values, those of the filter where they are zero: second order.
    np.testing.assert_allclose((causal.covs[-1] - final.covs[-1]) / np.outer(sigmas, sigmas), 0.0, atol=1e-6)
    np.testing.assert_allclose((causal.errors[-1] - final.errors[-1]) / sigmas, 0.0, atol=1e-6)


def test_more_measurements_only_lower_the_bound(sequence):
    """The final bound is below the causal one at every frame: their difference has no negative eigenvalue."""
    causal, final = efficient(sequence, "causal").covs, efficient(sequence, "final").covs
    whitener = np.linalg.inv(np.linalg.cholesky(causal))
    gained = np.eye(causal.shape[1]) - whitener @ final @ np.swapaxes(whitener, 1, 2)
    assert np.linalg.eigvalsh(gained).min() > -1e-3  # second order, as above
    # A gyro bias is known better in the end than at the first frame, by a tenth of its variance after two seconds.
    assert np.linalg.eigvalsh(gained[0]).max() > 0.05


@pytest.mark.parametrize("name", SHORT)
def test_the_efficient_estimates_errors_are_as_large_as_the_bound(name):
    seeds, squared = 8, []
    for seed in range(seeds):
        best = efficient(simulate(SHORT[name], seed), "causal")
        squared.append(best.errors[-1] @ np.linalg.solve(best.covs[-1], best.errors[-1]))
    dof = seeds * best.layout.size
    # Four sigma of a chi-square variable's mean.
    assert np.sum(squared) / dof == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dof))


def scores(run, sequence, output="causal", requested=("bound",)):
    found = score_run(run, output, sequence, requested)
    return {key: found.values[key] for key in KEYS}, found.notes


def with_error(sequence, make_run, extra, stated=1.0):
    """Return a run that errs by the efficient estimate's errors and by ``extra`` (6,) in every pose."""
    best, truth = efficient(sequence, "causal"), sequence.truth
    errors = best.errors.copy()
    errors[:, :6] += extra
    poses = truth.T_world_imu @ se3_inverse(se3_exp(errors[:, :6]))
    imu = best.layout.velocity is not None
    v_world = truth.v_world - (poses[:, :3, :3] @ errors[:, 6:9, None])[..., 0] if imu else None
    biases = errors[:, best.layout.biases] if imu else np.hstack([np.zeros((len(errors), 3)), errors[:, 6:]])
    trajectory = Trajectory(sequence.frames_t_ns, poses, v_world, truth.bias - biases, stated * best.covs)
    return make_run(sequence.frames_t_ns, poses, causal=trajectory, final=trajectory)


def test_what_an_estimator_errs_beyond_the_efficient_one_is_its_excess(sequence):
    best, extra = efficient(sequence, "causal"), np.array([0.0, 0.0, 1e-3, 0.02, 0.0, 0.0])
    values, _ = scores(with_error(sequence, make_run, np.zeros(6)), sequence)
    assert values["efficiency_percent"] == pytest.approx(100.0, abs=1e-3)
    assert values["excess_variance"] == pytest.approx(0.0, abs=1e-6)
    assert values["claimed_variance"] == pytest.approx(1.0)
    values, _ = scores(with_error(sequence, make_run, extra, stated=4.0), sequence)
    d = np.zeros(best.layout.size)
    d[:6] = extra
    expected = np.mean([d @ np.linalg.solve(cov, d) for cov in best.covs])
    assert values["excess_variance"] == pytest.approx(expected / best.layout.size, rel=1e-2)
    of_pose = np.mean([extra @ np.linalg.solve(cov[:6, :6], extra) for cov in best.covs]) / 6.0
    assert values["excess_pose"] == pytest.approx(of_pose, rel=1e-2)
    assert values["claimed_pose"] == pytest.approx(4.0)
    bound_m = values["bound_position_m"]
    assert values["efficiency_percent"] == pytest.approx(100.0 * bound_m / np.hypot(bound_m, 0.02), rel=1e-2)


@pytest.mark.parametrize(("name", "drawn"), [("flight", True), ("drive", False), ("flight", False)])
def test_a_full_smoother_attains_the_bound_and_an_ekf_with_a_hardened_map_does_not(run_estimator, name, drawn):
    """From a drawn start, or a measured one, as of a recording whose truth has every state.

    The excess needs no seeds: the draw of noise that both share is taken off. Among a hundred tracks, each of which the
    ekf believes too much.
    """
    sequence = simulate(replace(SHORT[name], camera=FLIGHT.camera if drawn else SHORT[name].camera), 1)
    if not drawn:
        sequence = replace(sequence, prior=None)
    start = sequence.prior or start_from_measurements(sequence)
    smoother, _ = scores(run_estimator("batch", sequence, start), sequence, "final")
    # Two in a thousand sightings are cut from batch's last solve, and it linearises at its own solution.
    assert smoother["excess_variance"] < 0.05
    assert smoother["claimed_variance"] == pytest.approx(1.0, abs=0.02)
    if drawn:
        ekf, _ = scores(run_estimator("ekf", sequence), sequence)
        assert ekf["excess_variance"] > 0.5
        assert ekf["claimed_pose"] < 0.5


def test_without_a_request_it_is_not_computed_and_says_how(sequence):
    values, notes = scores(with_error(sequence, make_run, np.zeros(6)), sequence, requested=())
    assert set(values.values()) == {None}
    assert notes["excess_variance"] == "computed on request: --set metrics.bound=true"
    assert requests_of(["excess_pose", "ATE SE(3)"]) == requests_of(["bound"]) == ("bound",)
    assert requests_of(["ATE SE(3)"]) == ()
    assert set(KEYS) <= set(describe())


@pytest.mark.parametrize(
    ("lacking", "why"),
    [
        ("truth", "no ground truth"),
        ("bias", "lacks bias"),
        ("stamps", "every frame"),
        ("exact", "the truth is not exact"),
    ],
)
def test_without_an_exact_truth_the_bound_is_what_the_model_claims_and_says_why(lacking, why):
    sequence = simulate(SHORT["drive"], 0)
    run, truth = with_error(sequence, make_run, np.zeros(6)), sequence.truth
    shaken = truth.T_world_imu.copy()
    shaken[:, :3, 3] += 0.05 * np.random.default_rng(0).standard_normal((len(shaken), 3))
    without = {
        "truth": None,
        "bias": replace(truth, bias=None),
        "stamps": replace(truth, t_ns=truth.t_ns + 1000),
        "exact": replace(truth, T_world_imu=shaken),
    }
    exact, _ = scores(run, sequence)
    values, notes = scores(run, replace(sequence, truth=without[lacking]))
    assert values["excess_variance"] is None
    assert why in notes["excess_variance"]
    assert why in notes["bound_position_m"]
    # The start of this run is drawn; what the model claims has the start from the measurements, which is the gauge.
    assert 0.0 < values["bound_position_m"] < 1.1 * exact["bound_position_m"]
    assert (values["error_over_bound"] is None) == (lacking == "truth")
