"""Reprojection errors: in-sample against gtsam's camera, held-out against re-triangulation, and over the motion."""

import itertools
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.metrics.conftest import RIG, drive_poses, make_run, make_sequence, perturb
from toolkit.answers import Run
from toolkit.estimate import Landmarks
from toolkit.geometry import se3_exp, se3_inverse, se3_log, transform
from toolkit.metrics import Evaluation, Scores, reprojection, score_run
from toolkit.metrics.parts.leave_one_out import CAP_PX, predict_left_out
from toolkit.metrics.reprojection import ERROR, RATIO
from toolkit.models import stereo
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence

PERIOD_S = 0.1
HUBER_SIGMAS = 2.796


def first_sighting_landmarks(sequence, poses):
    seen = sequence.visible
    ids, row = np.unique(seen.track_id, return_index=True)
    return Landmarks(ids, stereo.triangulate_world(seen.uv_px[row], poses[seen.frame[row]], sequence.rig))


def test_in_sample_error_equals_a_loop_over_gtsams_camera():
    sequence = make_sequence(drive_poses(60), track_count=80, pixel_sigma=0.7)
    poses, rig = perturb(sequence.truth.T_world_imu, 1e-4, seed=1), sequence.rig
    landmarks = first_sighting_landmarks(sequence, poses)
    calibration = gtsam.Cal3_S2Stereo(rig.fx_px, rig.fy_px, 0.0, rig.cx_px, rig.cy_px, rig.baseline_m)
    points = dict(zip(landmarks.track_ids.tolist(), landmarks.points_world, strict=True))
    expected = []
    for frame, track, uv in zip(sequence.visible.frame, sequence.visible.track_id, sequence.visible.uv_px, strict=True):
        camera = gtsam.StereoCamera(gtsam.Pose3(poses[frame] @ rig.T_imu_cam), calibration)
        predicted = camera.project(points[int(track)])
        residual = uv - [predicted.uL(), predicted.uR(), predicted.v()]
        expected.append(np.sqrt(np.mean(residual**2)))
    errors_px = reprojection.in_sample_errors(
        Evaluation(make_run(sequence.frames_t_ns, poses, landmarks), "final", sequence)
    )
    assert max(expected) < CAP_PX
    np.testing.assert_allclose(errors_px, expected, atol=1e-9)  # 1e3 px from products of a few doubles
    values = score_run(make_run(sequence.frames_t_ns, poses, landmarks), "final", sequence).values
    assert values["reproj_median_px"] == pytest.approx(np.median(expected), rel=1e-9)  # the same numbers
    assert values["reproj_rmse_px"] == pytest.approx(np.sqrt(np.mean(np.square(expected))), rel=1e-9)


def test_a_point_behind_the_camera_or_not_finite_counts_as_the_cap():
    sequence = make_sequence(drive_poses(60), track_count=80)
    landmarks = first_sighting_landmarks(sequence, sequence.truth.T_world_imu)
    points = landmarks.points_world.copy()
    points[0] = transform(sequence.truth.T_world_imu[0], np.array([-500.0, 0.0, 0.0]))
    points[1] = np.nan
    run = make_run(sequence.frames_t_ns, sequence.truth.T_world_imu, Landmarks(landmarks.track_ids, points))
    errors_px = reprojection.in_sample_errors(Evaluation(run, "final", sequence))
    lost = np.isin(sequence.visible.track_id, landmarks.track_ids[:2])
    assert (errors_px[lost] == 100.0).all()
    assert errors_px[~lost].max() < 1e-9  # exact points, rounding only
    assert f"{lost.sum()} behind the camera" in score_run(run, "final", sequence).notes["reproj_rmse_px"]


def test_held_out_error_is_zero_at_truth_and_grows_with_pose_noise():
    sequence = make_sequence(drive_poses(120), track_count=600)
    truth = sequence.truth.T_world_imu
    shape = np.random.default_rng(0).normal(size=(120, 6)) * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    medians = []
    for sigma in (0.0, 1e-4, 3e-4, 1e-3, 3e-3):
        poses = truth @ se3_exp(sigma * shape)
        run = make_run(sequence.frames_t_ns, poses)
        values = score_run(run, "final", sequence).values
        medians.append(values["heldout_reproj_median_px"])
    assert medians[0] < 1e-9  # rounding of 1e3 px
    assert all(1.5 * small < large for small, large in itertools.pairwise(medians))
    withheld = tracks_of(replace(sequence, observations=sequence.held_out), poses)
    predicted_px, in_front = predict_left_out(*withheld, RIG)
    assert in_front.all()
    errors_px = np.minimum(np.sqrt(np.mean((withheld[1] - predicted_px) ** 2, axis=1)), CAP_PX)
    assert values["heldout_reproj_median_px"] == pytest.approx(np.median(errors_px), rel=1e-9)  # the same numbers
    assert values["heldout_reproj_rmse_px"] == pytest.approx(np.sqrt(np.mean(errors_px**2)), rel=1e-9)


def tracks_of(sequence, poses):
    """All tracks with three views or more, sorted by track: ids, measurements, camera poses."""
    seen = sequence.observations
    order = np.lexsort((seen.frame, seen.track_id))
    enough = order[np.bincount(seen.track_id)[seen.track_id[order]] >= 3]
    return seen.track_id[enough], seen.uv_px[enough], (poses @ sequence.rig.T_imu_cam)[seen.frame[enough]]


def predict_by_retriangulation(track_ids, uv_px, T_world_cam, rig, left_out):
    """Triangulate the other views anew by scipy, robustly and in Cartesian coordinates, and predict."""
    others = np.flatnonzero(track_ids == track_ids[left_out])
    others = others[others != left_out]
    sqrt_information = np.linalg.inv(np.linalg.cholesky(rig.cov_uv_px2))

    def robust_residuals(point_world):
        points_cam = transform(se3_inverse(T_world_cam[others]), point_world)
        residual = (uv_px[others] - stereo.project(points_cam, rig)) @ sqrt_information.T
        length = np.linalg.norm(residual, axis=1)
        huber = np.where(length <= HUBER_SIGMAS, length**2, HUBER_SIGMAS * (2.0 * length - HUBER_SIGMAS))
        return (residual * (np.sqrt(huber) / np.maximum(length, 1e-12))[:, None]).ravel()

    starts = transform(T_world_cam[others], stereo.triangulate(uv_px[others], rig))
    solved = [least_squares(robust_residuals, start, xtol=1e-13, ftol=1e-13, gtol=1e-13) for start in starts[:4]]
    point = min(solved, key=lambda s: s.cost).x
    return stereo.project(transform(se3_inverse(T_world_cam[left_out]), point), rig)


def long_track():
    """One point that is seen from 80 places on 8 m: ids, measurements, camera poses."""
    T_world_cam = drive_poses(80, step_m=0.1) @ RIG.T_imu_cam
    point = transform(drive_poses(80, step_m=0.1)[79], np.array([12.0, 3.0, 1.0]))
    uv_px = stereo.project(transform(se3_inverse(T_world_cam), point), RIG)
    return np.zeros(80, dtype=np.int64), uv_px + np.random.default_rng(3).normal(0.0, 1.0, uv_px.shape), T_world_cam


def short_tracks(pixel_sigma, pose_sigma):
    sequence = make_sequence(drive_poses(80), track_count=60, pixel_sigma=pixel_sigma)
    noise = np.random.default_rng(1).normal(0.0, pose_sigma, (80, 6)) * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    return tracks_of(sequence, drive_poses(80) @ se3_exp(noise))


@pytest.mark.parametrize(
    ("tracks", "tolerance_px"),
    [
        (short_tracks(0.5, 0.0), 1e-4),  # no weight below one: both solve the same smooth problem to convergence
        (short_tracks(1.0, 1e-3), 0.15),  # weights at work: iteratively reweighted against jointly minimised
        (long_track(), 0.01),  # second-order terms and a weight or two of 79 others: a hundredth of the noise
    ],
    ids=["short", "weighed down", "long"],
)
def test_leaving_a_view_out_equals_triangulating_anew(tracks, tolerance_px):
    track_ids, uv_px, T_world_cam = tracks
    predicted_px = predict_left_out(track_ids, uv_px, T_world_cam, RIG)[0]
    rows = np.random.default_rng(2).choice(len(track_ids), 40, replace=False)
    anew_px = [predict_by_retriangulation(track_ids, uv_px, T_world_cam, RIG, row) for row in rows]
    np.testing.assert_allclose(predicted_px[rows], anew_px, atol=tolerance_px)
    assert np.median(np.abs(predicted_px[rows] - uv_px[rows])) > 0.3


def test_an_outlier_does_not_spoil_the_rest_of_its_track():
    sequence = make_sequence(drive_poses(80), track_count=60)
    track_ids, uv_px, T_world_cam = tracks_of(sequence, drive_poses(80))
    long = np.flatnonzero(np.bincount(track_ids) >= 8)
    struck = np.array([np.flatnonzero(track_ids == t)[3] for t in long])
    spoiled = uv_px.copy()
    spoiled[struck] += np.array([25.0, 20.0, 10.0])
    predicted_px, _ = predict_left_out(track_ids, spoiled, T_world_cam, sequence.rig)
    clean = np.setdiff1d(np.flatnonzero(np.isin(track_ids, long)), struck)
    np.testing.assert_allclose(predicted_px[struck], uv_px[struck], atol=1e-6)  # told by the other, exact views
    assert np.median(np.abs(predicted_px[clean] - uv_px[clean])) < 1.5  # Huber bounds the pull; least squares: 3 px


def test_points_at_infinity_are_predicted():
    rig, poses = make_sequence(drive_poses(10), track_count=3).rig, drive_poses(10)
    T_cam_world = se3_inverse(poses @ rig.T_imu_cam)
    directions = T_cam_world[:, :3, :3] @ (poses[5] @ rig.T_imu_cam)[:3, :3] @ np.array([0.1, -0.05, 1.0])
    uv_px = stereo.project(1e12 * directions, rig)
    predicted_px, _ = predict_left_out(np.zeros(10, dtype=np.int64), uv_px, poses @ rig.T_imu_cam, rig)
    np.testing.assert_allclose(predicted_px, uv_px, atol=1e-6)  # 1e12 m for infinity leaves fx b / 1e12


def test_tracks_with_fewer_than_three_posed_views_are_counted_not_scored():
    sequence = make_sequence(drive_poses(120), track_count=300)
    _, views = np.unique(sequence.held_out.track_id, return_counts=True)
    assert (views == 2).any()
    scores = score_run(make_run(sequence.frames_t_ns, sequence.truth.T_world_imu), "final", sequence)
    counted = f"{views[views >= 3].sum()} of {views.sum()} observations"
    assert counted in scores.notes["heldout_reproj_median_px"]
    assert scores.values["heldout_reproj_rmse_px"] < 1e-9  # exact: rounding only


@pytest.fixture
def recording() -> Sequence:
    """20 s with 240 withheld tracks and half a pixel of noise, whose twists scatter by 0.1 m/s and 0.005 rad/s."""
    poses = drive_poses(200)
    sequence = make_sequence(poses, track_count=2400, pixel_sigma=0.5)
    twists = se3_log(se3_inverse(poses[:-1]) @ poses[1:]) / PERIOD_S
    twists += np.random.default_rng(1).normal(0.0, np.repeat([0.005, 0.1], 3), twists.shape)
    values = np.concatenate([twists, twists[-1:]])
    return replace(sequence, motion=TwistSamples(sequence.frames_t_ns, values[:, 3:], values[:, :3]))


def scored(recording: Sequence, run: Run) -> Scores:
    return reprojection.score(Evaluation(run, "causal", recording))


def test_an_estimate_better_than_the_motion_is_below_one_and_nothing_is_reported(recording) -> None:
    scores = scored(recording, make_run(recording.frames_t_ns, recording.truth.T_world_imu))
    assert scores.values[RATIO] < 0.9
    assert RATIO not in scores.notes


def test_the_motion_alone_is_exactly_itself(recording) -> None:
    poses = recording.truth.T_world_imu
    motion = reprojection._motion_alone(make_run(recording.frames_t_ns, poses).causal, recording).causal
    scores = scored(recording, make_run(recording.frames_t_ns, motion.T_world_imu))
    assert (scores.values[RATIO], scores.values[ERROR]) == (1.0, 0.0)
    assert RATIO not in scores.notes


def test_an_estimate_that_leaps_for_three_seconds_is_reported_with_the_time(recording) -> None:
    poses = recording.truth.T_world_imu.copy()
    leaps = np.zeros((200, 6))
    leaps[98:128, 3] = np.random.default_rng(2).normal(0.0, 2.0, 30)
    scores = scored(recording, make_run(recording.frames_t_ns, poses @ se3_exp(leaps)))
    assert scores.values[RATIO] < 1.5  # three seconds of twenty hardly show in the whole
    assert "worse than dead reckoning" in scores.notes[RATIO]
    assert " times at 10-12 s" in scores.notes[RATIO]
    poses = perturb(recording.truth.T_world_imu, 0.02, seed=3)
    worse = scored(recording, make_run(recording.frames_t_ns, poses))  # all along: with its standard error
    assert f"{worse.values[RATIO]:.2f} +- " in worse.notes[RATIO]


def test_no_ratio_is_made_up_where_there_is_nothing_to_compare_with(recording) -> None:
    few = recording.truncated(15)
    scores = scored(few, make_run(few.frames_t_ns, recording.truth.T_world_imu[:15]))
    assert scores.values[RATIO] is None and "withheld tracks have 3 views" in scores.notes[RATIO]
    imu = make_sequence(drive_poses(60), motion="imu")
    assert "no velocity" in scored(imu, make_run(imu.frames_t_ns, imu.truth.T_world_imu)).notes[RATIO]
