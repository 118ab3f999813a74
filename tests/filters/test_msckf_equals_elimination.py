"""Eliminating the landmarks by the Schur complement is one Gauss-Newton step over poses and landmarks.

What is said of each track is compared with dense matrices in test_tracks.py. The filter as a whole is compared with the
batch on a problem that is linear in effect, as in test_joint_ekf_equals_batch.py.
"""

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from filters.kalman.coordinates import CloneAnchoredBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, JointBelief
from filters.msckf import Msckf
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded, update_by_rows, with_clones
from toolkit.geometry import se3_inverse, se3_log
from toolkit.settings import Settings
from toolkit.settings import Window as WindowSettings
from toolkit.simulation import DRIVE, FLIGHT

CLONES = 6


@pytest.mark.parametrize("rows", [5, 60])
@pytest.mark.parametrize("first", [0, 2], ids=["of all clones", "of the newest"])
def test_information_on_the_newest_clones_corrects_as_the_rows_it_is_made_of(rows, first):
    _, joint = with_clones(replace(FLIGHT, duration_s=0.5), 0, CLONES)
    rng = np.random.default_rng(6)
    begin, end = joint.clone_columns.start + 6 * first, joint.clone_columns.stop
    H, residuals = 100.0 * rng.normal(size=(rows, end - begin)), rng.normal(size=rows)
    core, clones, other, sigmas = joint.core, joint.clones, copy.copy(joint), np.sqrt(np.diag(joint.cov))
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
