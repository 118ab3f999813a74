"""The gate of the windowed filters: which tracks, and which of their sightings, may correct the window.

A track is accepted or rejected as a whole, and one mismatched sighting would have all the others rejected with it. So
where a track fails the gate by a wide margin, the sighting that disagrees most with the rest of the track and with the
window is left out, and the track is tested once more if two sightings remain. One that fails by little may be a sound
track with bad luck: to leave out its worst sighting would choose the measurements by their agreement.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman import multiview
from filters.kalman.gate import FrameGate
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation
from filters.kalman.multiview import Constraints, Linearised, TrackSightings
from filters.kalman.triangulation import triangulate
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import FEWEST_SIGHTINGS, MISMATCHED_TRACK_FACTOR, mahalanobis_squared
from toolkit.sequence import StereoRig


class AcceptedTracks(NamedTuple):
    """F tracks that passed: the sightings that count, points (F, 3), and their constraints on the window."""

    sightings: TrackSightings
    points: Array
    linearised: Linearised
    constraints: Constraints

    def select(self, rows: BoolArray | IntArray) -> "AcceptedTracks":
        """Return some of the tracks."""
        linearised, constraints = self.linearised.select(rows), self.constraints.select(rows)
        return AcceptedTracks(self.sightings.select(rows), self.points[rows], linearised, constraints)

    def weighed(self, weights: Array) -> "AcceptedTracks":
        """Return the tracks as if their noise were larger, each by its weight (F,)."""
        roots = np.sqrt(weights)
        return self._replace(linearised=self.linearised.scaled(roots), constraints=self.constraints.scaled(roots))

    def joined(self, other: "AcceptedTracks") -> "AcceptedTracks":
        """Return both together."""
        return AcceptedTracks(
            self.sightings.joined(other.sightings),
            np.concatenate([self.points, other.points]),
            self.linearised.joined(other.linearised),
            self.constraints.joined(other.constraints),
        )


class TrackGate:
    """Tests tracks against a joint belief."""

    def __init__(self, joint: JointBelief, at: Linearisation, rig: StereoRig) -> None:
        self._joint, self._at, self._rig = joint, at, rig

    def accepted(self, sightings: TrackSightings, gate: FrameGate) -> AcceptedTracks:
        """Return the tracks that pass, some of them without one of their sightings.

        ``gate`` counts every test, so a track that is tested twice counts twice.
        """
        accepted, mismatched = self._tested(sightings, gate)
        again = mismatched.select(mismatched.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
        return accepted.joined(self._tested(again, gate)[0]) if len(again.track_ids) else accepted

    def _tested(self, sightings: TrackSightings, gate: FrameGate) -> tuple[AcceptedTracks, TrackSightings]:
        """Return the tracks that pass as they are, and those that fail by far less their worst sighting."""
        joint = self._joint
        points, reliable = triangulate(sightings.uvs_px, sightings.seen, joint.clones, self._rig)
        sightings, points = sightings.select(reliable), points[reliable]
        if self._rig.track_noise is not None:
            points = multiview.refined(sightings, points, joint.clones, self._rig)
        linearised = multiview.linearise(sightings, points, joint.clones, self._at.clones(joint), self._rig)
        linearised = multiview.decorrelated(linearised, sightings, self._rig)
        constraints = multiview.without_landmark(linearised, sightings.seen)
        covs = self._covs(constraints)
        nis = mahalanobis_squared(constraints.residuals, covs)
        accepted = gate.accepts(nis, constraints.dof)
        weights = gate.weights(nis, constraints.dof, accepted)
        tracks = AcceptedTracks(sightings, points, linearised, constraints)
        mismatched = np.asarray(nis > MISMATCHED_TRACK_FACTOR * gate.bound(constraints.dof))
        seen = sightings.seen[mismatched]
        if len(seen):
            worst = _worst_sighting(tracks.select(mismatched), covs[mismatched])
            seen[np.arange(len(worst)), worst] = False
        return tracks.select(accepted).weighed(weights[accepted]), sightings.select(mismatched)._replace(seen=seen)

    def _covs(self, constraints: Constraints) -> Array:
        """Return the covariance (F, 3W - 3, 3W - 3) of each track's residuals."""
        P = self._joint.cov[self._joint.clone_columns, self._joint.clone_columns]
        covs = constraints.H @ P @ np.swapaxes(constraints.H, 1, 2)
        variances = np.einsum("fii->fi", covs)
        variances += 1.0
        return np.asarray(covs)


def _worst_sighting(tracks: AcceptedTracks, covs: Array) -> IntArray:
    """Return the sighting (F,) of each track without which its NIS would be least.

    ``covs`` (F, 3W - 3, 3W - 3) are those of the tracks' residuals. Leaving out a sighting is letting it be anything:
    with ``W`` the precision of all coordinates and ``r`` their residuals, the NIS falls by
    ``(W r)_j^T W_jj^-1 (W r)_j``.
    """
    seen = tracks.sightings.seen
    count, window = seen.shape
    basis = multiview.null_space(tracks.linearised)
    informed = np.linalg.solve(covs, np.concatenate([basis, tracks.constraints.residuals[..., None]], axis=2))
    weighted = (np.swapaxes(basis, 1, 2) @ informed[..., -1:]).reshape(count, window, 3)
    own = np.swapaxes(multiview.by_pose(basis), 2, 3) @ multiview.by_pose(informed[..., :-1])
    own = np.where(seen[..., None, None], own, np.eye(3))
    fall = (weighted * np.linalg.solve(own + 1e-12 * np.eye(3), weighted[..., None])[..., 0]).sum(axis=2)
    return np.asarray(np.argmax(np.where(seen, fall, -1.0), axis=1))
