"""Eliminating the landmarks by the Schur complement is one Gauss-Newton step over poses and landmarks.

The parts are compared at full noise, where both sides linearise at the same values. The filter as a whole is
compared with the batch on a problem that is linear in effect, as in test_joint_ekf_equals_batch.py.
"""

import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from filters.kalman.coordinates import CloneAnchoredBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, JointBelief, propagate
from filters.kalman.tracks import EliminatedTracks, WindowPoses, WindowTracks, eliminated_tracks
from filters.msckf import Msckf
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded, update_by_rows
from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.models.factors import L, StereoFactors, V, X
from toolkit.models.gating import FrameGate
from toolkit.models.motion import motion_model
from toolkit.settings import Settings
from toolkit.settings import Window as WindowSettings
from toolkit.simulation import DRIVE, FLIGHT

CLONES = 6
SCENARIOS = [replace(DRIVE, duration_s=0.5), replace(FLIGHT, duration_s=0.25)]
every_scenario = pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)


class Window(NamedTuple):
    """A belief with a clone a frame and no correction yet, and the tracks that its clones saw."""

    joint: JointBelief
    tracks: EliminatedTracks


def window_of(recording) -> Window:
    setup = recording.setup
    model = motion_model(setup.noise, setup.gravity_world)
    joint, tracks = JointBelief(model.initial_belief(setup.prior)), WindowTracks()
    for packet in recording.sequence.packets():
        propagate(joint, model, AtLatestEstimates(), packet.motion)
        joint.clone()
        tracks.add_frame(packet.frame)
    taken = tracks.take(tracks.seen.sum(axis=1) >= 2)
    columns = joint.clone_columns
    poses = WindowPoses(joint.clones, joint.clones, joint.cov[columns, columns])
    return Window(joint, eliminated_tracks(taken, poses, setup.rig, FrameGate(None)))


class GaussNewtonStep:
    """The same window as a linear graph: X the clones, V(0) the rest of the IMU's state, L landmarks with no prior."""

    def __init__(self, window: Window, recording) -> None:
        joint = window.joint
        self.rest = joint.core.layout.size - 6
        prior = np.linalg.inv(np.linalg.cholesky(joint.cov[6:, 6:]))
        terms = [(V(0), prior[:, : self.rest])]
        values = gtsam.Values()
        for c, pose in enumerate(joint.clones):
            values.insert(X(c), gtsam.Pose3(pose))
            terms.append((X(c), prior[:, self.rest + 6 * c :][:, :6]))
        for track_id, point in zip(window.tracks.track_ids.tolist(), window.tracks.points, strict=True):
            values.insert(L(track_id), point)
        seen = gtsam.NonlinearFactorGraph()
        for packet in recording.sequence.packets():
            used = np.isin(packet.frame.track_ids, window.tracks.track_ids)
            for factor in StereoFactors(recording.sequence.rig).of(packet.frame.select(used), packet.index):
                seen.add(factor)
        linear = seen.linearize(values)
        # A factor on more than three variables is to be had from Python as a conditional only.
        unit = gtsam.noiseModel.Unit.Create(len(prior))
        linear.push_back(gtsam.GaussianConditional(terms, len(terms), np.zeros(len(prior)), unit))
        self._keys = [V(0), *(X(c) for c in range(len(joint.clones)))]
        self._delta = linear.optimize()
        self._marginals = gtsam.Marginals(linear, self._delta)

    def of(self, landmarks: list[int]) -> tuple[Array, Array]:
        """Return the correction of the state, some landmarks and the clones, and their covariance."""
        keys = [self._keys[0], *(L(i) for i in landmarks), *self._keys[1:]]
        joint = self._marginals.jointMarginalCovariance(keys)
        cov = np.block([[joint.at(one, other) for other in keys] for one in keys])
        return np.concatenate([self._delta.at(key) for key in keys]), cov


def moved(before, after: JointBelief, first_points: Array) -> Array:
    """Return by how much an update moved what lies behind the pose, the landmarks and the clones."""
    core, clones = before
    bias = after.core.bias - core.bias
    if core.layout.velocity is None:
        rest = bias[3:]
    else:
        rest = np.concatenate([core.T_world_imu[:3, :3].T @ (after.core.v_world - core.v_world), bias])
    poses = se3_log(se3_inverse(clones) @ after.clones)
    return np.concatenate([rest, (after.points - first_points).ravel(), poses.ravel()])


@every_scenario
@pytest.mark.parametrize("kept", [0, 5])
def test_an_update_by_tracks_is_one_gauss_newton_step(scenario, kept):
    recording = recorded(scenario, 1.0)
    window = window_of(recording)
    joint, tracks = window
    step = GaussNewtonStep(window, recording)
    before = joint.core, joint.clones
    track_ids, points, jacobian, covs = tracks.landmarks(np.arange(kept))
    joint.add_landmarks(track_ids, points, jacobian, covs)
    joint.inform(tracks.blocks, tracks.halves.reshape(-1, len(tracks.vector)), tracks.vector)
    mean, cov = step.of(track_ids.tolist())
    # A landmark is added as if it were at its least squares; the search ends micrometres before.
    mean[step.rest :][: 3 * kept] -= (covs @ tracks.normals[:kept, 3, :3, None]).ravel()
    assert np.abs(moved(before, joint, points) - mean).max() < 1e-7
    assert np.abs(mean).max() > 1e-3, "there was something to agree on"
    assert_covariances_agree(joint.cov[6:, 6:], cov, 1e-6)


@pytest.mark.parametrize("rows", [5, 60])
@pytest.mark.parametrize("first", [0, 2], ids=["of all clones", "of the newest"])
def test_information_on_the_newest_clones_corrects_as_the_rows_it_is_made_of(rows, first):
    joint, *_ = window_of(recorded(SCENARIOS[1], 1.0))
    rng = np.random.default_rng(6)
    begin, end = joint.clone_columns.start + 6 * first, joint.clone_columns.stop
    H, residuals = 100.0 * rng.normal(size=(rows, end - begin)), rng.normal(size=rows)
    before, other, sigmas = (joint.core, joint.clones), copy.copy(joint), np.sqrt(np.diag(joint.cov))
    update_by_rows(joint, H, residuals, slice(begin, end))
    information, most = H.T @ H, 2.0 * (H**2).sum()
    taken = np.linalg.cholesky(most * np.eye(len(information)) - information).T
    other.inform(np.tile(most * np.eye(6), (len(information) // 6, 1, 1)), taken, H.T @ residuals)
    steps, others = moved(before, joint, joint.points), moved(before, other, other.points)
    assert np.abs(steps).max() > 1e-3, "there was something to agree on"
    np.testing.assert_allclose(others, steps, atol=1e-9)
    np.testing.assert_allclose(other.cov / np.outer(sigmas, sigmas), joint.cov / np.outer(sigmas, sigmas), atol=1e-9)
    np.testing.assert_array_equal(other.cov, other.cov.T)


def seen_twice(sequence):
    """Return the tracks that tie two poses together."""
    track_ids, counts = np.unique(sequence.visible.track_id, return_counts=True)
    return track_ids[counts > 1]


# With room for every track, each sighting is used once however long the run; with none, while the window fills. In view
# of the newest pose, tracks have corrected nothing that is kept, and the answer is that of the batch all the same.
SIZES = {
    "in view": (9, 0, 7),
    "one window": (9, 0, 10),
    "every landmark kept": (4, 10**6, 21),
    "every landmark anchored": (4, 10**6, 21),
}


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
@pytest.mark.parametrize(("at", "weight"), [(AtFirstEstimates(), 1.0), (AtLatestEstimates(), 0.25)])
@pytest.mark.parametrize("size", SIZES)
def test_the_filters_answer_is_that_of_the_batch_of_its_tracks(scenario, at, size, weight):
    """Errors of 1e-6 of the stated noise: the gates are open and second orders out of sight."""
    clones, landmarks, frames = SIZES[size]
    recording = recorded(linear(scenario, (frames - 1) / scenario.camera.rate_hz), 1e-6)
    rig = replace(recording.sequence.rig, track_weight=weight)
    recording = replace(recording, sequence=replace(recording.sequence, rig=rig))
    # A pose leaves in the frame in which it is older than the window.
    lag_s = (clones - 0.5) / scenario.camera.rate_hz
    settings = Settings(window=WindowSettings(lag_s=lag_s))
    anchored = partial(CloneAnchoredBelief, T_imu_cam=rig.T_imu_cam, at=at)
    belief = anchored if size == "every landmark anchored" else JointBelief
    msckf = Msckf(replace(recording.setup, settings=settings), at, landmarks, belief=belief)
    for packet in recording.sequence.packets():
        estimate = msckf.step(packet)
        assert estimate.info["gate_accepted"] == estimate.info["gate_tested"]
    used = seen_twice(recording.sequence)
    assert len(used) > 20
    assert size != "in view" or len(msckf.landmarks().track_ids) < len(used) / 2
    mean, cov = BatchAtTruth(recording, used).state(packet.index)
    # The corrections are a millionth of centimetres; the second order is a millionth of that.
    assert np.abs(recording.error_of(estimate, packet.index) - mean).max() < 1e-3 * np.abs(mean).max()
    assert_covariances_agree(estimate.cov, cov, 1e-6)
