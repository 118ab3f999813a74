"""The Cramér-Rao bound where the errors of a track are correlated: it equals the dense inverse, and is attained."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import Array
from toolkit.metrics import score_run
from toolkit.metrics.parts import cramer_rao
from toolkit.metrics.parts.cramer_rao import Efficient, efficient
from toolkit.metrics.parts.information_filter import LinearisedProblem
from toolkit.models import left_only, stereo
from toolkit.models.correlated_noise import white_rig
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE_IMU, SCENARIOS, simulate
from toolkit.simulation.track_faults import persistent_mismatch
from toolkit.track_noise import CHANNELS, TrackNoise

# White noise, walk and offset in every channel, none of them small.
MIXED = TrackNoise(np.array([0.3, 0.5, 0.2]), np.array([0.1, 0.13, 0.07]), np.array([0.2, 0.9, 0.1]))
_DURATIONS_S = {"drive-realistic": 3.0, "flight-realistic": 1.5}
SHORT = {
    name: replace(SCENARIOS[name], slip_share=0.0, duration_s=duration_s) for name, duration_s in _DURATIONS_S.items()
} | {"mixed": replace(DRIVE_IMU, duration_s=2.0, track_noise=MIXED)}
KEYS = ("excess_variance", "claimed_variance", "claimed_pose", "bound_position_m")


def told(name: str, seed: int, max_tracks: int = 40) -> Sequence:
    """Return a short recording that states the noise its tracks have."""
    scenario = replace(SHORT[name], camera=replace(SHORT[name].camera, max_tracks=max_tracks))
    return stating(simulate(scenario, seed), scenario.track_noise)


def stating(sequence: Sequence, noise: TrackNoise | None) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, track_noise=noise))


def without_right_images(sequence: Sequence) -> Sequence:
    """Return a recording that lacks the right image of every fourth sighting."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[np.random.default_rng(0).uniform(size=len(uv_px)) < 0.25, 1] = np.nan
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


def begun_before(sequence: Sequence) -> Sequence:
    """Return a recording with so small a budget that many tracks are given from a later age on."""
    return replace(sequence, track_budget=12)


CHANGES = {"whole": lambda one: one, "left only": without_right_images, "begun before": begun_before}


@pytest.fixture(params=CHANGES)
def change(request):
    return CHANGES[request.param]


def apart(first: Efficient, second: Efficient, rows: slice) -> tuple[float, float]:
    """Return the largest difference of covariances and of errors at some frames, in standard deviations."""
    sigmas = np.sqrt(np.einsum("kii->ki", second.covs[rows]))
    covs = (first.covs[rows] - second.covs[rows]) / (sigmas[:, :, None] * sigmas[:, None, :])
    return float(np.abs(covs).max()), float(np.abs((first.errors[rows] - second.errors[rows]) / sigmas).max())


@pytest.mark.parametrize("name", SHORT)
def test_at_the_last_frame_the_causal_bound_is_the_final_one(name, change):
    """The one is a forward filter with an error for each track, the other decorrelates whole tracks."""
    sequence = change(told(name, 3))
    covs, errors = apart(efficient(sequence, "causal"), efficient(sequence, "final"), slice(-1, None))
    # GTSAM's Jacobians are taken at the residuals' values, those of the filter where they are zero: second order.
    assert covs < 1e-3
    assert errors < 1e-2


def test_the_bound_is_the_inverse_of_the_information_with_the_dense_covariance_of_all_sightings(change):
    sequence = change(told("mixed", 2, max_tracks=16)).truncated(9)
    problem = cramer_rao._problem_at_truth(sequence)
    assert all((one.frame.ages > 0).any() for one in problem.packets[1:])
    dense = [by_inversion(problem, k + 1, MIXED) for k in range(sequence.frame_count)]
    causal = Efficient(problem.prior.layout, np.array([c[-1] for c, _ in dense]), np.array([e[-1] for _, e in dense]))
    covs, errors = apart(efficient(sequence, "causal"), causal, slice(None))
    assert covs < 1e-6  # rounding, and the least error of a track, 1e-4 px
    assert errors < 1e-6
    covs, errors = apart(efficient(sequence, "final"), Efficient(problem.prior.layout, *dense[-1]), slice(None))
    assert covs < 1e-3  # second order, as above
    assert errors < 1e-2


def by_inversion(problem: LinearisedProblem, count: int, noise: TrackNoise) -> tuple[Array, Array]:
    """Return the covariances (K, d, d) and errors (K, d) from the measurements of the first ``count`` frames."""
    d, points = problem.prior.layout.size, problem.points
    frames = [(k, packet.frame) for k, packet in enumerate(problem.packets[:count])]
    seen = np.unique(np.concatenate([problem.rows(frame) for _, frame in frames]))
    size = d * count + 3 * len(seen)
    information, score = np.zeros((size, size)), np.zeros(size)

    def add(columns: Array, jacobian: Array, residual: Array, cov: Array) -> None:
        weighted = jacobian.T @ np.linalg.inv(cov)
        information[np.ix_(columns, columns)] += weighted @ jacobian
        score[columns] += weighted @ residual

    add(np.arange(d), np.eye(d), problem.states[0].error_to(problem.prior), problem.prior.cov)
    for k in range(1, count):
        before, now = problem.states[k - 1], problem.states[k]
        increment = problem.model.integrate(problem.packets[k].motion, before.bias)
        predicted = increment.predict(before)
        at_truth = predicted._replace(T_world_imu=now.T_world_imu, v_world=now.v_world)
        jacobian = np.hstack([-increment.transition_between(before, at_truth), np.eye(d)])
        residual = now.error_to(before.predicted(predicted))
        add(np.arange(d * (k - 1), d * (k + 1)), jacobian, residual, predicted.noise)
    rows, residuals, ages, tracks, white = [], [], [], [], []
    rig = white_rig(noise, problem.sightings.noise.rig)
    for k, frame in frames:
        for row, uv_px, age in zip(problem.rows(frame), frame.uvs_px, frame.ages, strict=True):
            expected = stereo.predict(points[row][None], problem.states[k].T_world_imu, rig)
            jacobian = np.zeros((3, size))
            jacobian[:, d * k : d * k + 6] = expected.d_uv_d_pose[0]
            own = d * count + 3 * np.searchsorted(seen, row)
            jacobian[:, own : own + 3] = expected.d_uv_d_point[0]
            rows.append(jacobian)
            residuals.append(uv_px - expected.uv_px[0])
            ages.append(age)
            tracks.append(row)
            white.append(left_only.noise_px2(uv_px, rig))
    shared = replace(noise, white_px=np.zeros(3)).cov(np.array(ages, dtype=float))
    shared = shared * (np.array(tracks)[:, None] == np.array(tracks))
    to_uv = np.linalg.inv(CHANNELS)
    cov = np.einsum("ac,cjk,bc->jakb", to_uv, shared, to_uv)
    cov[np.arange(len(ages)), :, np.arange(len(ages)), :] += np.array(white)
    measured = ~np.isnan(np.concatenate(residuals))
    cov = cov.reshape(measured.size, measured.size)[np.ix_(measured, measured)]
    add(np.arange(size), np.concatenate(rows)[measured], np.concatenate(residuals)[measured], cov)
    whole = np.linalg.inv(information)
    covs = np.array([whole[d * k : d * (k + 1), d * k : d * (k + 1)] for k in range(count)])
    return covs, -(whole @ score)[: d * count].reshape(count, d)


@pytest.mark.parametrize("output", ["causal", "final"])
def test_without_walk_and_offset_it_is_the_bound_of_white_noise(output):
    sequence = simulate(replace(SHORT["mixed"], track_noise=None), 1)
    channels_px2 = CHANNELS @ sequence.rig.cov_uv_px2 @ CHANNELS.T
    white = TrackNoise(np.sqrt(np.diag(channels_px2)), np.zeros(3), np.zeros(3))
    nearly = replace(white, walk_px=np.full(3, 1e-6), offset_px=np.full(3, 1e-6))
    expected = efficient(sequence, output)
    for noise, tolerance in ((white, 1e-8), (nearly, 1e-3 if output == "final" else 1e-6)):
        covs, errors = apart(efficient(stating(sequence, noise), output), expected, slice(None))
        assert covs < tolerance  # rounding; the least error of a track, 1e-4 px
        assert errors < tolerance


@pytest.mark.parametrize("name", SHORT)
def test_the_efficient_estimates_errors_are_as_large_as_the_bound(name):
    seeds, squared = 8, {"causal": [], "final": []}
    for seed in range(seeds):
        sequence = told(name, seed)
        for output, found in squared.items():
            best = efficient(sequence, output)
            middle = len(best.covs) // 2  # where the outputs differ
            found.append(best.errors[middle] @ np.linalg.solve(best.covs[middle], best.errors[middle]))
    dof = seeds * best.layout.size
    for found in squared.values():
        # Four sigma of a chi-square variable's mean.
        assert np.sum(found) / dof == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dof))


@pytest.mark.parametrize("name", ["drive-realistic", "flight-realistic"])
def test_tracks_are_used_up_to_where_they_slip(name):
    sound = told(name, 1, max_tracks=80)
    slipped = persistent_mismatch(sound, 0.2, 1)
    off = (sound.observations.uv_px != slipped.observations.uv_px).any(axis=1)
    wrong = {*zip(sound.observations.frame[off].tolist(), sound.observations.track_id[off].tolist(), strict=True)}
    seen = {*zip(slipped.visible.frame.tolist(), slipped.visible.track_id.tolist(), strict=True)}
    problem = cramer_rao._problem_at_truth(slipped)
    kept = {(one.index, int(i)) for one in problem.packets for i in one.frame.track_ids}
    assert len(wrong & seen) > 50
    assert kept >= seen - wrong
    # A track that has slipped after its first sighting is as good as one of another landmark, that sighting apart.
    assert len(wrong & kept) < 0.03 * len(wrong & seen)
    assert len(cramer_rao._problem_at_truth(sound).sightings.track) == len(sound.visible)


def test_a_single_mismatched_sighting_is_left_out_and_no_other_of_its_track():
    sequence = told("drive-realistic", 1)
    row = int(np.flatnonzero(sequence.observations.frame == 12)[3])
    track = sequence.observations.track_id[row]
    assert track in sequence.visible.track_id
    uv_px = sequence.observations.uv_px.copy()
    uv_px[row] += [4.0, 4.0, -3.0]
    problem = cramer_rao._problem_at_truth(replace(sequence, observations=replace(sequence.observations, uv_px=uv_px)))
    kept = {(one.index, int(i)) for one in problem.packets for i in one.frame.track_ids}
    seen = {*zip(sequence.visible.frame.tolist(), sequence.visible.track_id.tolist(), strict=True)}
    assert seen - kept == {(12, int(track))}


@pytest.mark.parametrize("name", ["drive-realistic", "flight-realistic"])
def test_a_full_smoother_attains_and_claims_the_bound(run_estimator, name):
    sequence = told(name, 1, max_tracks=80)
    found = score_run(run_estimator("batch", sequence), "final", sequence, ("bound",), only=KEYS).values
    # Its Student-t over tracks and the Markov chain of their errors cost some percent.
    assert 0.0 < found["excess_variance"] < 0.05
    assert found["claimed_variance"] == pytest.approx(1.0, abs=0.05)


def test_where_tracks_err_otherwise_than_stated_there_is_no_bound_to_lose_against(run_estimator):
    sequence = told("drive-realistic", 0)
    wrong = stating(sequence, sequence.rig.track_noise.scaled(0.5))
    found = score_run(run_estimator("batch", wrong), "final", wrong, ("bound",), only=KEYS)
    assert found.values["excess_variance"] is None and found.values["claimed_pose"] is not None
    assert "the noise is not as stated" in found.notes["excess_variance"]
