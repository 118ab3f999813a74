"""Tracks of an MSCKF: their kernels against the textbook in dense matrices, the gate's policy, the answer in view.

That the filter as a whole is one Gauss-Newton step is proved in test_linear_problems.py.
"""

import subprocess
import sys
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, null_space
from scipy.optimize import least_squares

from filters.kalman import kernels
from filters.kalman.joint import AtFirstEstimates
from filters.kalman.tracks import (
    TrackSightings,
    WindowPoses,
    WindowTracks,
    camera_for_kernels,
    eliminated_tracks,
    given_tracks_in_view,
)
from tests.filters.conftest import update_by_rows, with_clones
from toolkit.geometry import se3, se3_inverse, se3_log, so3_exp
from toolkit.measurements import StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, FrameGate, chi2_bound
from toolkit.simulation import DRIVE, FLIGHT

WIDTH, TRACKS = 9, 40
# Both round at 1e-16 of terms that cancel by up to a million, the carried covariance against the noise of a pixel.
TOLERANCE = 1e-9


# The textbook (Mourikis & Roumeliotis 2007, eqs. 17-26): one track in dense matrices.


def rows_of(uvs_px, weights, point, window, rig):
    """Return r (3 W,), H_x (3 W, 6 W) and H_f (3 W, 3) of a track, whitened and weighted, zero where unseen."""
    width = len(window.poses)
    r, H_x, H_f = np.zeros(3 * width), np.zeros((3 * width, 6 * width)), np.zeros((3 * width, 3))
    for j in np.flatnonzero(weights):
        now, at = (stereo.predict(point[None], poses[j], rig) for poses in (window.poses, window.poses_at))
        whitener = np.sqrt(weights[j]) * stereo.whitener(uvs_px[j], rig)
        three = slice(3 * j, 3 * j + 3)
        r[three] = whitener @ stereo.residuals_px(uvs_px[j], now.uv_px[0])
        H_x[three, 6 * j : 6 * j + 6], H_f[three] = whitener @ at.d_uv_d_pose[0], whitener @ at.d_uv_d_point[0]
    return r, H_x, H_f


def without_landmark(r, H_x, H_f):
    """Return residuals and Jacobian on the left null space of the landmark's Jacobian."""
    null = null_space(H_f.T)
    return null.T @ r, null.T @ H_x


def nis_of(uvs_px, weights, point, window, rig):
    """Return the NIS of a track's constraints on the window."""
    r, H = without_landmark(*rows_of(uvs_px, weights, point, window, rig))
    return r @ np.linalg.solve(H @ window.cov @ H.T + np.eye(len(r)), r)


def nis_of_newest(uvs_px, weights, point, window, rig):
    """Return the NIS of the newest sighting given the window and the landmark that the others of its track place."""
    r, H_x, H_f = rows_of(uvs_px, weights, point, window, rig)
    follows = H_f[-3:] @ np.linalg.pinv(H_f[:-3])
    innovation, H = r[-3:] - follows @ r[:-3], H_x[-3:] - follows @ H_x[:-3]
    return innovation @ np.linalg.solve(H @ window.cov @ H.T + follows @ follows.T + np.eye(3), innovation)


def least_squares_point(uvs_px, seen, start, window, rig):
    """Return the point of least squared error, and its information (3, 3)."""
    here = window._replace(poses_at=window.poses)
    fit = least_squares(
        lambda p: rows_of(uvs_px, seen.astype(float), p, here, rig)[0], start, x_scale="jac", xtol=1e-14, ftol=1e-14
    )
    return fit.x, fit.jac.T @ fit.jac


def found_of(sightings, window, rig, probability=0.95):
    """Return what the kernel finds of tracks."""
    return kernels.eliminate_tracks(
        (sightings.uvs_px, sightings.seen),
        (window.poses, window.poses_at),
        np.ascontiguousarray(window.cov),
        camera_for_kernels(rig),
        (LEAST_DISPARITY_PX, LEAST_DEPTH_M),
        FrameGate(probability).limits(3 * sightings.seen.shape[1]),
        (2.0, 1.0),
    )


@pytest.fixture(scope="module")
def flight():
    """A window of a flight, corrected once so that first and latest estimates differ."""
    sequence, joint = with_clones(replace(FLIGHT, duration_s=1.0), 2, WIDTH)
    update_by_rows(joint, np.eye(6, 6 * WIDTH, 6 * WIDTH - 6) * 40.0, np.full(6, 0.3), joint.clone_columns)
    return sequence.rig, joint, window_of(joint)


def window_of(joint):
    columns = joint.clone_columns
    return WindowPoses(joint.clones, AtFirstEstimates().clones(joint), joint.cov[columns, columns])


def sightings_in(rig, window, left_only=0.0) -> TrackSightings:
    """Return tracks of all lengths and with gaps; some mismatched, one behind the camera, one too far."""
    rng = np.random.default_rng(5)
    rays = np.stack([rng.uniform(-0.6, 0.6, TRACKS), rng.uniform(-0.4, 0.4, TRACKS), np.ones(TRACKS)], axis=1)
    in_imu = (rays * rng.uniform(3.0, 20.0, TRACKS)[:, None]) @ rig.T_imu_cam[:3, :3].T + rig.T_imu_cam[:3, 3]
    points = in_imu @ window.poses[-1, :3, :3].T + window.poses[-1, :3, 3]
    uvs_px = np.stack([stereo.predict(points, T, rig).uv_px for T in window.poses], axis=1)
    uvs_px += rng.normal(size=uvs_px.shape) @ np.linalg.cholesky(rig.cov_uv_px2).T
    uvs_px[:6, 4] += [25.0, 20.0, -30.0]
    uvs_px[6, :, 1] = uvs_px[6, :, 0] - 0.2
    uvs_px[7, :, :2] = uvs_px[7, :, 1::-1]
    seen = rng.random((TRACKS, WIDTH)) < rng.uniform(0.3, 1.0, TRACKS)[:, None]
    seen[:, 4:6] = True
    uvs_px[rng.random((TRACKS, WIDTH)) < left_only, 1] = np.nan
    return TrackSightings(np.arange(TRACKS), uvs_px, seen)


@pytest.mark.parametrize("left_only", [0.0, 0.3])
def test_tracks_are_tested_as_in_the_textbook(flight, left_only):
    rig, _, window = flight
    sightings = sightings_in(rig, window, left_only)
    points, reliable, nis, dof, worst, weights, (_, halves, of_halves, of_poses, vector) = found_of(
        sightings, window, rig
    )
    assert reliable.sum() > 25 and not reliable[7]
    assert (worst[reliable] >= 0).any() and np.unique(weights).tolist() == [0.0, 1.0]
    missing = sightings.seen & np.isnan(sightings.uvs_px[..., 1])
    assert dof.tolist() == (3 * sightings.seen.sum(axis=1) - missing.sum(axis=1) - 3).tolist()
    information, right = np.zeros((6 * WIDTH, 6 * WIDTH)), np.zeros(6 * WIDTH)
    for f in np.flatnonzero(reliable):
        uvs_px, seen = sightings.uvs_px[f], sightings.seen[f].astype(float)
        assert nis[f] == pytest.approx(nis_of(uvs_px, seen, points[f], window, rig), rel=TOLERANCE)
        assert weights[f] == (nis[f] < chi2_bound(dof[f], 0.95))
        r, H = without_landmark(*rows_of(uvs_px, seen, points[f], window, rig))
        information += weights[f] * H.T @ H
        right += weights[f] * H.T @ r
        if worst[f] >= 0 and sightings.seen[f].sum() > 2:  # of two sightings one is as bad as the other
            without = [nis_of(uvs_px, seen * (np.arange(WIDTH) != j), points[f], window, rig) for j in range(WIDTH)]
            without = np.where(sightings.seen[f], without, np.inf)
            assert without[worst[f]] == pytest.approx(without.min(), rel=1e-6)
    assert block_diag(*of_poses) - halves.T @ halves == pytest.approx(
        information, abs=TOLERANCE * np.abs(information).max()
    )
    assert vector - halves.T @ of_halves == pytest.approx(right, abs=TOLERANCE * np.abs(right).max())


@pytest.mark.parametrize("left_only", [0.0, 0.3])
def test_landmarks_are_the_least_squares_points(flight, left_only):
    """The search ends where it has nothing to gain: a hundredth of a standard deviation of the point."""
    rig, _, window = flight
    sightings = sightings_in(rig, window, left_only)
    points, reliable, nis, dof, *_ = found_of(sightings, window, rig)
    for f in np.flatnonzero(reliable & (nis < chi2_bound(dof, 0.95))):
        best, information = least_squares_point(sightings.uvs_px[f], sightings.seen[f], points[f], window, rig)
        assert (points[f] - best) @ information @ (points[f] - best) < 0.01**2


RIG = StereoRig(450.0, 455.0, 360.0, 240.0, 0.11, np.eye(4), np.diag([1.0, 1.0, 0.5]))


def exact_tracks(seed: int, width: int = 6):
    """Return exact points (F, 3), their exact sightings, two at least each, and the window."""
    rng = np.random.default_rng(seed)
    turns = so3_exp(0.05 * rng.standard_normal((width, 3)))
    poses = se3(turns, np.cumsum(0.2 * rng.standard_normal((width, 3)), axis=0))
    points = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], size=(TRACKS, 3))
    uvs_px = np.stack([stereo.predict(points, pose, RIG).uv_px for pose in poses], axis=1)
    seen = rng.uniform(size=(TRACKS, width)) < 0.6
    seen[:, :2] = True
    return (
        points,
        TrackSightings(np.arange(TRACKS), uvs_px, seen),
        WindowPoses(poses, poses, np.zeros((6 * width,) * 2)),
    )


def test_exact_sightings_give_the_points_where_one_right_image_or_the_rays_determine_them():
    points, sightings, window = exact_tracks(0)
    sightings.uvs_px[::3, 1:, 1] = np.nan
    sightings.uvs_px[1::3, :, 1] = np.nan
    found, reliable, *_ = found_of(sightings, window, RIG)
    assert reliable[::3].all() and reliable[2::3].all()
    assert reliable[1::3].mean() > 0.8, "most are seen from far enough apart"
    np.testing.assert_allclose(found[reliable], points[reliable], atol=1e-5)


def test_what_determines_no_point_is_not_relied_on():
    """Parallel rays by whatever half a pixel of noise leaves of their angle, no disparity, a point behind a pose."""
    _, sightings, window = exact_tracks(0)
    again = np.repeat(sightings.uvs_px[:, :1], 6, axis=1)
    again[..., 1] = np.nan
    noise_px = 0.5 * np.random.default_rng(0).standard_normal(again.shape)
    one_place = np.ascontiguousarray(np.broadcast_to(window.poses[0], window.poses.shape))
    for seen_px in (again, again + noise_px):
        assert not found_of(sightings._replace(uvs_px=seen_px), window._replace(poses=one_place), RIG)[1].any()
    flat = sightings.uvs_px.copy()
    flat[0, :, 1] = flat[0, :, 0]
    assert found_of(sightings._replace(uvs_px=flat), window, RIG)[1].tolist() == [False] + [True] * (TRACKS - 1)
    behind = window.poses.copy()
    behind[1, :3, :3] = so3_exp(np.array([0.0, np.pi, 0.0]))
    assert not found_of(sightings, WindowPoses(behind, behind, window.cov), RIG)[1].any()


# The gate's policy.

VIEWS, SOUND = 6, 12


@pytest.fixture(scope="module")
def scene():
    """A window of exact clones and tracks of exact points seen from all of them, with ordinary noise."""
    sequence, joint = with_clones(replace(DRIVE, duration_s=1.5), 2, VIEWS)
    rng = np.random.default_rng(0)
    ahead = np.stack([rng.uniform(14, 25, SOUND), rng.uniform(-6, 6, SOUND), rng.uniform(-2, 2, SOUND)], axis=1)
    points = ahead @ joint.clones[-1][:3, :3].T + joint.clones[-1][:3, 3]
    uvs_px = np.stack([stereo.predict(points, T, sequence.rig).uv_px for T in joint.clones], axis=1)
    uvs_px += rng.normal(size=uvs_px.shape) @ np.linalg.cholesky(sequence.rig.cov_uv_px2).T * 0.5
    return joint, sequence.rig, TrackSightings(np.arange(SOUND), uvs_px, np.ones((SOUND, VIEWS), dtype=bool))


def gated(scene, sightings, mismatches=()):
    """Return the tracks that pass and the gate's counts; the sightings ``mismatches`` (track, view) are made wrong."""
    joint, rig, _ = scene
    uvs_px, gate = sightings.uvs_px.copy(), FrameGate(0.95)
    for n, (track, view) in enumerate(mismatches):
        uvs_px[track, view] += [[40.0, 40.0, -30.0], [-35.0, -30.0, 25.0]][n]
    passed = eliminated_tracks(sightings._replace(uvs_px=uvs_px), window_of(joint), rig, gate)
    return passed, (gate.tested, gate.accepted)


def information_of(tracks):
    halves = tracks.halves.reshape(-1, len(tracks.vector))
    return block_diag(*tracks.blocks) - halves.T @ halves


@pytest.mark.parametrize("view", [None, 0, 2, VIEWS - 1])
def test_a_mismatched_sighting_costs_a_track_that_sighting_alone(scene, view):
    passed, counts = gated(scene, scene[2], () if view is None else [(4, view)])
    assert sorted(passed.track_ids) == list(range(SOUND))
    row = passed.track_ids.tolist().index(4)
    assert passed.seen[row].tolist() == [other != view for other in range(VIEWS)]
    assert counts == (SOUND + (view is not None), SOUND)
    without = scene[2]._replace(seen=scene[2].seen.copy())
    if view is not None:
        without.seen[4, view] = False
    expected = information_of(gated(scene, without)[0])
    np.testing.assert_allclose(information_of(passed), expected, atol=TOLERANCE * np.abs(expected).max())


def test_two_mismatches_cost_the_track_and_so_does_one_of_two_sightings(scene):
    passed, counts = gated(scene, scene[2], [(7, 0), (7, 3)])
    assert 7 not in passed.track_ids and counts == (SOUND + 1, SOUND - 1)
    twice = scene[2]._replace(seen=np.tile(np.arange(VIEWS) < 2, (SOUND, 1)))
    passed, counts = gated(scene, twice, [(3, 1)])
    assert 3 not in passed.track_ids and counts == (SOUND, SOUND - 1)


def test_no_track_at_all_is_no_test(scene):
    passed, counts = gated(scene, scene[2].select(np.zeros(SOUND, dtype=bool)))
    assert len(passed.points) == 0 and not information_of(passed).any() and counts == (0, 0)


# The answer given the tracks in view.


@pytest.mark.parametrize(("probability", "huber"), [(0.95, None), (0.999, 1.0), (None, None)])
@pytest.mark.parametrize("left_only", [0.0, 0.3])
def test_the_answer_in_view_is_the_dense_update_by_all_sightings_that_count(flight, probability, huber, left_only):
    """Of tracks with rejected and weighed sightings, newest ones that do not fit and one that is behind a camera."""
    rig, joint, window = flight
    rig, gate = replace(rig, track_weight=0.5), FrameGate(probability, huber)
    tracks = tracks_in(rig, window, left_only)
    points, before = tracks.points.copy(), tracks.weights.copy()
    answer = given_tracks_in_view(joint, window, tracks, rig, gate)
    usable = ~np.isnan(tracks.points[:, 0])
    assert 25 < usable.sum() < TRACKS and not usable[7]
    rows = []
    for f in np.flatnonzero(usable):
        nis = np.array([nis_of_newest(tracks.uvs_px[f], before[f], points[f], window, rig)])
        dof = 2 if np.isnan(tracks.uvs_px[f, -1, 1]) else 3
        expected = gate.weights(nis, dof, nis < chi2_bound(dof, probability))
        assert tracks.weights[f, -1] == pytest.approx(expected[0], rel=1e-7)
        weights = rig.track_weight * tracks.weights[f]
        rows.append(without_landmark(*rows_of(tracks.uvs_px[f], weights, points[f], window, rig)))
    found = tracks.weights[usable, -1]
    assert (found == 0.0).any() == (probability is not None)
    assert ((found > 0.0) & (found < 1.0)).any() == (huber is not None)
    assert_dense_update(joint, answer, *(np.concatenate(parts) for parts in zip(*rows, strict=True)))


def test_a_single_track_in_view_is_used_as_many_are(flight):
    rig, joint, window = flight
    tracks = tracks_in(rig, window, left_only=0.0)
    tracks.seen[1:, -1] = False
    point = tracks.points[0].copy()
    answer = given_tracks_in_view(joint, window, tracks, rig, FrameGate(None))
    assert_dense_update(
        joint, answer, *without_landmark(*rows_of(tracks.uvs_px[0], tracks.weights[0], point, window, rig))
    )


def assert_dense_update(joint, answer, r, H):
    """Assert that an answer is the belief's core after the Kalman update by residuals r (m,) of the clones."""
    d = joint.core.layout.size
    gain = joint.cov[:d, d:] @ H.T @ np.linalg.inv(H @ joint.cov[d:, d:] @ H.T + np.eye(len(r)))
    cov, sigmas = joint.core.cov - gain @ H @ joint.cov[d:, :d], np.sqrt(np.diag(answer.cov))
    assert answer.cov / np.outer(sigmas, sigmas) == pytest.approx(cov / np.outer(sigmas, sigmas), abs=1e-6)
    assert joint.core.error_to(answer) / sigmas == pytest.approx(gain @ r / sigmas, abs=1e-5)


def tracks_in(rig, window, left_only) -> WindowTracks:
    """Return tracks that the newest pose sees, with landmarks a little off and some sightings that count less."""
    sightings, rng = sightings_in(rig, window), np.random.default_rng(6)
    tracks = WindowTracks()
    tracks.track_ids, tracks.uvs_px, tracks.seen = sightings
    tracks.seen[:, -1] = True
    tracks.uvs_px[10:14, -1] += [30.0, 28.0, 15.0]
    tracks.points = found_of(sightings, window, rig)[0] + 0.1 * rng.normal(size=(TRACKS, 3))
    tracks.points[7] = window.poses[-1, :3, 3] - 5.0 * window.poses[-1, :3, :3] @ rig.T_imu_cam[:3, 2]
    tracks.uvs_px[rng.random((TRACKS, WIDTH)) < left_only, 1] = np.nan
    weights = rng.choice([0.0, 0.4, 1.0], (TRACKS, WIDTH), p=[0.1, 0.2, 0.7])
    weights[:, 4:] = 1.0
    weights[20:25, 4] = 0.6
    tracks.weights = weights * tracks.seen
    return tracks


def test_the_belief_is_left_as_it_was(flight):
    rig, joint, window = flight
    before = copy(joint)
    answer = given_tracks_in_view(joint, window, tracks_in(rig, window, left_only=0.0), rig, FrameGate(0.95))
    np.testing.assert_array_equal(joint.cov, before.cov)
    np.testing.assert_array_equal(joint.clones, before.clones)
    assert np.linalg.det(answer.cov[:6, :6]) < 0.1 * np.linalg.det(joint.core.cov[:6, :6])


# The update by information.


@pytest.mark.parametrize("rows", [5, 60])
@pytest.mark.parametrize("first", [0, 2], ids=["of all clones", "of the newest"])
def test_information_on_the_newest_clones_corrects_as_the_rows_it_is_made_of(rows, first):
    _, joint = with_clones(replace(FLIGHT, duration_s=0.5), 0, VIEWS)
    rng = np.random.default_rng(6)
    begin, end = joint.clone_columns.start + 6 * first, joint.clone_columns.stop
    H, residuals = 100.0 * rng.normal(size=(rows, end - begin)), rng.normal(size=rows)
    core, clones, other, sigmas = joint.core, joint.clones, copy(joint), np.sqrt(np.diag(joint.cov))
    update_by_rows(joint, H, residuals, slice(begin, end))
    information, most = H.T @ H, 2.0 * (H**2).sum()
    taken = np.linalg.cholesky(most * np.eye(len(information)) - information).T
    other.inform(np.tile(most * np.eye(6), (len(information) // 6, 1, 1)), taken, H.T @ residuals)
    steps, others = (
        np.concatenate([core.error_to(it.core), se3_log(se3_inverse(clones) @ it.clones).ravel()])
        for it in (joint, other)
    )
    assert np.abs(steps).max() > 1e-3, "there was something to agree on"
    np.testing.assert_allclose(others, steps, atol=1e-9)
    np.testing.assert_allclose(other.cov / np.outer(sigmas, sigmas), joint.cov / np.outer(sigmas, sigmas), atol=1e-9)
    np.testing.assert_array_equal(other.cov, other.cov.T)


# How the kernels are compiled.


def test_importing_the_toolkit_and_its_estimators_imports_no_numba():
    code = (
        "import sys, toolkit, toolkit.cli\n"
        "from toolkit.registry import discover\n"
        "[entry.load() for entry in discover().values()]\n"
        "print('numba' in sys.modules)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == "False"


def test_a_kernel_that_cannot_be_cached_is_compiled_for_this_process(monkeypatch):
    """No folder can be written: numba refuses to cache, and the result is the same."""
    from numba import types
    from numba.core.caching import CompileResultCacheImpl

    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    assert kernels.kernel(types.float64)(lambda x: x + 1.0)(1.0) == 2.0
