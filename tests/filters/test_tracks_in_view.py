"""Tracks in view correct the answer and leave the belief alone; a sighting that does not fit them corrects nothing.

That the answer is the one of the batch of all tracks is proved in test_msckf_equals_elimination.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from filters import msckf_fej
from filters.kalman.linearisation import AtFirstEstimates, propagate
from filters.kalman.sliding_window import JointBelief, WindowTracks
from filters.kalman.tracks_in_view import TracksInView
from toolkit.models.motion import motion_model
from toolkit.runner import run
from toolkit.settings import POLICIES
from toolkit.simulation import DRIVE, FLIGHT, simulate

SCENARIO = replace(FLIGHT, duration_s=0.4, camera=replace(FLIGHT.camera, max_tracks=30))


def answers(recording, change=lambda frame: frame, policy="classic"):
    """Return a window that nothing corrects, and the answer at each frame; ``change`` alters what the frames show."""
    setup, at = recording.setup, AtFirstEstimates()
    model = motion_model(setup.noise, setup.gravity_world)
    joint, tracks = JointBelief(model.initial_belief(setup.prior)), WindowTracks()
    in_view, found = TracksInView(at, setup.rig, POLICIES[policy]), []
    for packet in recording.sequence.packets():
        propagate(joint, model, at, packet.motion)
        joint.clone(packet.index)
        tracks.add_frame(change(packet.frame))
        unused = tracks.unused()
        found.append(in_view.corrected(joint, unused.select(unused.seen[:, -1])))
    return joint, found


def test_the_belief_is_left_as_it_was(oracle):
    recording = oracle.recorded(SCENARIO, 1.0)
    setup, joint = recording.setup, None
    model = motion_model(setup.noise, setup.gravity_world)
    joint, found = answers(recording)
    untouched = JointBelief(model.initial_belief(setup.prior))
    for packet in recording.sequence.packets():
        propagate(untouched, model, AtFirstEstimates(), packet.motion)
        untouched.clone(packet.index)
    np.testing.assert_array_equal(joint.cov, untouched.cov)
    np.testing.assert_array_equal(joint.clones, untouched.clones)
    assert np.linalg.det(found[-1].cov[:6, :6]) < 0.1 * np.linalg.det(joint.core.cov[:6, :6])


def test_a_mismatched_sighting_counts_for_nothing(oracle):
    """Not in its frame nor in later ones: the answers are those of a recording without it."""
    recording, when = oracle.recorded(SCENARIO, 1.0), 4
    before, frame = [packet.frame for packet in recording.sequence.packets()][when - 1 : when + 1]
    track = frame.track_ids[np.isin(frame.track_ids, before.track_ids)][0]

    def displaced(seen):
        of_track = (seen.track_ids == track) & (seen.t_ns == frame.t_ns)
        return replace(seen, uvs_px=seen.uvs_px + np.where(of_track[:, None], [40.0, 40.0, 0.0], 0.0))

    def without(seen):
        return seen.select((seen.track_ids != track) | (seen.t_ns != frame.t_ns))

    (_, sound), (_, wrong), (_, left_out) = (answers(recording, change) for change in (lambda f: f, displaced, without))
    _, ungated = answers(recording, displaced, "none")
    assert in_sigmas(wrong[when], sound[when]) < 1.0
    assert in_sigmas(ungated[when], sound[when]) > 2.0
    # A track that is not seen in one frame is triangulated anew in the next: second orders differ.
    from_left_out, from_sound = (
        max(map(in_sigmas, wrong[when + 1 :], others[when + 1 :])) for others in (left_out, sound)
    )
    assert from_left_out < 0.2 * from_sound


def in_sigmas(one, other):
    """Return by how many standard deviations of a coordinate two answers' positions differ at most."""
    step = other.T_world_imu[:3, :3].T @ (one.T_world_imu[:3, 3] - other.T_world_imu[:3, 3])
    return np.abs(step / np.sqrt(np.diag(other.cov)[3:6])).max()


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_the_newest_pose_is_better_than_one_carried_by_the_motion_and_knows_it(scenario, monkeypatch):
    sequence = simulate(replace(scenario, duration_s=2.0), 5)
    answer = run("one", msckf_fej.build, sequence, sequence.prior).causal
    monkeypatch.setattr(TracksInView, "corrected", lambda self, joint, sightings: joint.core)
    carried = run("one", msckf_fej.build, sequence, sequence.prior).causal
    squared_m2 = [
        np.square(trajectory.T_world_imu[:, :3, 3] - sequence.truth.T_world_imu[:, :3, 3]).sum(axis=1).mean()
        for trajectory in (answer, carried)
    ]
    assert squared_m2[0] < squared_m2[1]
    volumes = [np.linalg.slogdet(trajectory.cov[:, :6, :6])[1] for trajectory in (answer, carried)]
    assert (volumes[0] <= volumes[1] + 1e-9).all()
