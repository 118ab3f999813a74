"""A mismatched sighting costs a track that sighting alone, where the margin is wide."""

from dataclasses import replace

import numpy as np
import pytest

from filters.kalman import multiview, track_gate
from filters.kalman.frame_gate import FrameGate
from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import TrackGate, WindowPoses, innovation_covs
from filters.kalman.triangulation import triangulate
from toolkit.models import stereo
from toolkit.models.gating import chi2_bound, mahalanobis_squared
from toolkit.simulation import DRIVE

WINDOW, TRACKS = 6, 12


@pytest.fixture(scope="module")
def scene(window_of_clones):
    """A window of exact clones and tracks of exact points seen from all of them, with ordinary noise."""
    sequence, joint = window_of_clones(replace(DRIVE, duration_s=1.5), 2, WINDOW)
    rng = np.random.default_rng(0)
    ahead = np.stack([rng.uniform(14, 25, TRACKS), rng.uniform(-6, 6, TRACKS), rng.uniform(-2, 2, TRACKS)], axis=1)
    points = ahead @ joint.clones[-1][:3, :3].T + joint.clones[-1][:3, 3]
    uvs_px = np.stack([stereo.predict(points, T, sequence.rig).uv_px for T in joint.clones], axis=1)
    uvs_px += rng.normal(size=uvs_px.shape) @ np.linalg.cholesky(sequence.rig.cov_uv_px2).T * 0.5
    return joint, sequence.rig, TrackSightings(np.arange(TRACKS), uvs_px, np.ones((TRACKS, WINDOW), dtype=bool))


def mismatched(sightings: TrackSightings, errors: dict[int, list[int]]) -> TrackSightings:
    uvs_px = sightings.uvs_px.copy()
    for track, views in errors.items():
        for n, view in enumerate(views):
            uvs_px[track, view] += [[40.0, 40.0, -30.0], [-35.0, -30.0, 25.0], [20.0, 60.0, 45.0]][n]
    return sightings._replace(uvs_px=uvs_px)


def gated(scene, sightings: TrackSightings):
    joint, rig, _ = scene
    gate = FrameGate(0.95)
    return TrackGate(joint, AtLatestEstimates(), rig).accepted(sightings, gate), gate


def test_sound_tracks_all_pass_as_they_are(scene):
    accepted, gate = gated(scene, scene[2])
    assert sorted(accepted.sightings.track_ids) == list(range(TRACKS))
    assert gate.tested == gate.accepted == TRACKS
    assert len(accepted.H) == len(accepted.residuals) == TRACKS * (3 * WINDOW - 3)


@pytest.mark.parametrize("view", [0, 2, WINDOW - 1])
def test_the_mismatched_sighting_is_the_one_left_out(scene, view):
    accepted, gate = gated(scene, mismatched(scene[2], {4: [view]}))
    row = accepted.sightings.track_ids.tolist().index(4)
    assert accepted.sightings.seen[row].tolist() == [other != view for other in range(WINDOW)]
    assert (gate.tested, gate.accepted) == (TRACKS + 1, TRACKS)


def test_two_mismatches_cost_the_track(scene):
    accepted, gate = gated(scene, mismatched(scene[2], {7: [0, 3]}))
    assert 7 not in accepted.sightings.track_ids
    assert (gate.tested, gate.accepted) == (TRACKS + 1, TRACKS - 1)


def test_the_fall_predicted_is_what_leaving_the_sighting_out_brings(scene):
    """The NIS without a sighting, from the precision of all, equals that of the track linearised without it."""
    joint, rig, sightings = scene
    bad = mismatched(sightings, {4: [2]})
    without = bad.select(np.array([4]))._replace(seen=(np.arange(WINDOW) != 2)[None])
    points, _ = triangulate(without.uvs_px, without.seen, joint.clones, rig)
    with_it = multiview.linearise(bad.select(np.array([4])), points, joint.clones, joint.clones, rig)
    alone = multiview.linearise(without, points, joint.clones, joint.clones, rig)

    P = joint.cov[joint.clone_columns, joint.clone_columns]

    def nis(linearised, sightings):
        constraints = multiview.without_landmark(linearised, sightings)
        return float(mahalanobis_squared(constraints.residuals, innovation_covs(constraints, P))[0])

    assert nis(with_it, bad.select(np.array([4]))) > 50.0 * nis(alone, without)
    accepted, _ = gated(scene, bad)
    assert accepted.points[accepted.sightings.track_ids.tolist().index(4)] == pytest.approx(points[0], abs=1e-6)


def test_a_track_seen_twice_that_disagrees_is_rejected(scene):
    twice = scene[2]._replace(seen=np.tile(np.arange(WINDOW) < 2, (TRACKS, 1)))
    accepted, _ = gated(scene, mismatched(twice, {3: [1]}))
    assert 3 not in accepted.sightings.track_ids
    assert len(accepted.sightings.track_ids) == TRACKS - 1


def test_no_track_at_all_is_no_test(scene):
    accepted, gate = gated(scene, scene[2].select(np.zeros(TRACKS, dtype=bool)))
    assert len(accepted.points) == 0
    assert gate.tested == 0


def test_tracks_seen_late_are_tested_as_with_the_whole_window(scene, monkeypatch):
    """In groups, some with a mismatched sighting: of rows in another basis products are alike, 1e-9 is rounding."""
    joint, rig, sightings = scene
    sightings = mismatched(sightings, {0: [2], 5: [3], 8: [4]})
    sightings = sightings._replace(seen=np.arange(WINDOW) >= np.arange(TRACKS)[:, None] % (WINDOW - 1))
    arguments = sightings, WindowPoses.of(joint, AtLatestEstimates()), rig, chi2_bound(np.arange(3 * WINDOW), 0.95)
    whole = track_gate.tested(*arguments)
    monkeypatch.setattr(track_gate, "_LEAST_LEFT_OUT", 1)
    assert len(list(track_gate._by_first_pose(sightings.seen))) == 3
    grouped = track_gate.tested(*arguments)
    assert grouped.nis == pytest.approx(whole.nis, rel=1e-9)
    assert grouped.dof.tolist() == whole.dof.tolist()
    assert grouped.worst.tolist() == whole.worst.tolist()
    assert (whole.worst >= 0).any()
    assert set(grouped.track) == set(whole.track)
    for track in set(whole.track):
        a, b = whole.H[whole.track == track], grouped.H[grouped.track == track]
        r, s = whole.residuals[whole.track == track], grouped.residuals[grouped.track == track]
        assert b.T @ b == pytest.approx(a.T @ a, abs=1e-9 * np.abs(a.T @ a).max())
        assert b.T @ s == pytest.approx(a.T @ r, abs=1e-9 * np.abs(a.T @ a).max())
