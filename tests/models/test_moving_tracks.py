"""Which sightings are left out for moving against the rest: vehicles and what slips, and not what noise explains."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from toolkit.geometry import Array, BoolArray, transposed
from toolkit.models import moving_tracks
from toolkit.models.moving_tracks import LeftOut, without_moving_tracks
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Sequence, is_held_out
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, simulate
from toolkit.simulation.faults import linear_unit, moving_vehicles


@lru_cache(maxsize=3)
def simulated(scenario: str = "drive") -> Sequence:
    """Return four seconds with about 80 visible tracks a frame and noise of a pixel."""
    scenarios: dict[str, Scenario] = {"drive": DRIVE, "drive-imu": DRIVE_IMU, "flight": FLIGHT}
    return simulate(replace(scenarios[scenario], duration_s=4.0), 1)


def checked(sequence: Sequence) -> tuple[BoolArray, LeftOut]:
    """Return which sightings (N,) of a sequence are left out, and the counts."""
    assert sequence.prior is not None
    left, counts = without_moving_tracks(sequence, sequence.prior)
    return ~np.isin(keys(sequence), keys(left)), counts


def keys(sequence: Sequence) -> Array:
    """Return a number for each sighting (N,)."""
    return sequence.observations.track_id * 10_000 + sequence.observations.frame


def shifted(sequence: Sequence, rows: Array, by_px: Array) -> Sequence:
    """Return the sequence with some sightings (M,) moved in the column by so many pixels (M,)."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[rows, :2] += by_px[:, None]
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


def as_one_vehicle(sequence: Sequence, rows: BoolArray) -> Sequence:
    """Return the sequence with the points of some sightings (N,) carried along at a third of the camera's velocity."""
    truth, seen = sequence.truth, sequence.observations
    assert truth is not None
    poses = truth.T_world_imu[np.searchsorted(truth.t_ns, sequence.frames_t_ns)] @ sequence.rig.T_imu_cam
    travelled = (poses[:, :3, 3] - poses[0, :3, 3]) / 3.0
    points = triangulate(seen.uv_px, sequence.rig)
    carried = points + (transposed(poses[seen.frame][:, :3, :3]) @ travelled[seen.frame][:, :, None])[..., 0]
    shift_px = project(carried, sequence.rig) - project(points, sequence.rig)
    moved = replace(seen, uv_px=seen.uv_px + np.where((rows & (carried[:, 2] > 1.0))[:, None], shift_px, 0.0))
    return replace(sequence, observations=moved)


def long_tracks(sequence: Sequence, frames: int) -> list[Array]:
    """Return the rows, in order of time, of each visible track that is seen in so many frames."""
    ids, counts = np.unique(sequence.observations.track_id, return_counts=True)
    wanted = ids[(counts >= frames) & ~is_held_out(ids)]
    return [np.flatnonzero(sequence.observations.track_id == i) for i in wanted]


def test_of_sound_sightings_as_many_are_left_out_as_the_probability_says():
    """Two tests each, at one in a thousand: of 9000 sightings 18, and 5 is three standard deviations of that less."""
    left_out = [checked(simulated(name))[1] for name in ("drive", "drive-imu", "flight")]
    share = sum(one.sightings for one in left_out) / sum(one.of_sightings for one in left_out)
    assert 0.0003 < share < 0.004
    assert sum(one.undecided_frames for one in left_out) == 0


def test_vehicles_are_left_out_and_what_stands_is_not():
    """With an IMU nothing but vision tells the speed, and half of the sightings are on vehicles."""
    for name in ("drive", "drive-imu", "flight"):
        standing = simulated(name)
        among = moving_vehicles(standing, dose=0.5, seed=1)
        out, _ = checked(among)
        where = np.searchsorted(keys(standing), keys(among), sorter=np.argsort(keys(standing)))
        before_px = standing.observations.uv_px[np.argsort(keys(standing))[where]]
        off_px = np.abs(among.observations.uv_px - before_px).max(axis=1)
        visible = ~is_held_out(among.observations.track_id)
        # What has moved by two pixels is within the noise of two sightings of one each; by ten it is not.
        assert out[visible & (off_px > 10.0)].mean() > 0.85
        assert out[visible & (off_px == 0.0)].mean() < 0.02


def test_a_frame_is_checked_by_what_was_seen_until_then():
    among = moving_vehicles(simulated(), dose=0.3, seed=1)
    whole, part = checked(among)[0], checked(among.truncated(25))[0]
    np.testing.assert_array_equal(whole[among.observations.frame < 25], part)
    assert part.any()


def test_held_out_tracks_stay_whatever_they_do():
    among = moving_vehicles(simulated(), dose=0.5, seed=1)
    assert among.prior is not None
    left, counts = without_moving_tracks(among, among.prior)
    np.testing.assert_array_equal(left.held_out.uv_px, among.held_out.uv_px)
    assert counts.sightings == len(among.observations) - len(left.observations)


def test_a_bad_sighting_spoils_no_other_of_its_track():
    sequence = simulated("flight")
    bad = np.array([rows[6] for rows in long_tracks(sequence, 15)[:8]])
    out, _ = checked(shifted(sequence, bad, np.full(bad.size, 25.0)))
    clean, _ = checked(sequence)
    assert out[bad].all()
    # Beside these, what chance leaves out: hardly any of them is tested from another sighting than before.
    assert (out != clean).sum() <= bad.size + 2


def test_a_track_refused_in_three_frames_running_stays_out():
    sequence = simulated("flight")
    tracks = long_tracks(sequence, 15)[:8]
    for frames, stays_out in ((2, False), (3, True)):
        bad = np.concatenate([rows[6 : 6 + frames] for rows in tracks])
        out, _ = checked(shifted(sequence, bad, np.full(bad.size, 25.0)))
        assert out[bad].all()
        later = np.concatenate([rows[6 + frames :] for rows in tracks])
        assert out[later].mean() == 1.0 if stays_out else out[later].mean() < 0.05


def test_what_moves_slowly_shows_over_some_frames(monkeypatch):
    """Two pixels are within the noise of two sightings, which is one in each coordinate; ten are not."""
    sequence = simulated("flight")
    tracks = [rows[:12] for rows in long_tracks(sequence, 12)[:10]]
    creeping = shifted(sequence, np.concatenate(tracks), np.tile(2.0 * np.arange(12.0), len(tracks)))
    last = np.concatenate([rows[8:] for rows in tracks])
    assert checked(creeping)[0][last].mean() > 0.6
    monkeypatch.setattr(moving_tracks, "EARLY_FRAMES", 1)
    assert checked(creeping)[0][last].mean() < 0.3


def test_tracks_that_agree_on_another_motion_than_was_measured_are_kept():
    """A wheel of the wrong size: the speed is off by twenty standard deviations, and nine tracks in ten agree on it."""
    sequence = linear_unit(simulated(), dose=1.1)
    out, counts = checked(sequence)
    assert out.mean() < 0.03
    assert counts.undecided_frames == 0


def test_a_convoy_is_not_taken_for_the_motion_where_odometry_excludes_it():
    """Three tracks in five move as one at a third of the camera's speed: the larger consensus, and not the motion."""
    sequence = simulated()
    ids = np.unique(sequence.observations.track_id)
    struck = np.isin(sequence.observations.track_id, ids[np.random.default_rng(2).uniform(size=ids.size) < 0.6])
    out, _ = checked(as_one_vehicle(sequence, struck))
    visible = ~is_held_out(sequence.observations.track_id)
    assert out[visible & ~struck].mean() < 0.02
    assert out[visible & struck].mean() > 0.5


def test_where_fewer_than_half_agree_none_is_refused():
    sequence = simulated()
    struck = np.flatnonzero(sequence.observations.frame == 20)
    off_px = np.random.default_rng(0).choice([-1.0, 1.0], struck.size) * np.linspace(20.0, 200.0, struck.size)
    out, counts = checked(shifted(sequence, struck, off_px))
    assert counts.undecided_frames >= 1
    assert out[struck].mean() < 0.05
