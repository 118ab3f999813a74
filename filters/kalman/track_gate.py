"""The gate of the windowed filters: which tracks, and which of their sightings, may correct the window.

A track speaks as a whole, so that one slipped sighting would silence all the others. Where a track fails the
gate beyond all doubt, the sighting that disagrees most with the rest of the track and with the window is given up
and the track asks again, once, if two sightings are left. One that fails by little may be a sound track with bad
luck: to look for the sighting to blame would be to choose the measurements by their agreement.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman import multiview
from filters.kalman.diagnostics import Innovation
from filters.kalman.gate import gate_at
from filters.kalman.joint import JointBelief
from filters.kalman.linearisation import Linearisation
from filters.kalman.multiview import Constraints, Linearised, Sightings
from filters.kalman.triangulation import triangulate
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.sequence import StereoRig

# A track this many times beyond its gate has slipped: chance does not reach there.
SLIPPED_FACTOR = 2.0
FEWEST_SIGHTINGS = 2


class Heard(NamedTuple):
    """F tracks that passed: ids (F,), who saw what (F, W), points (F, 3), and what the sightings say of the window."""

    track_ids: IntArray
    seen: BoolArray
    points: Array
    linearised: Linearised
    said: Constraints

    def select(self, rows: BoolArray | IntArray) -> "Heard":
        """Return some of the tracks."""
        linearised = Linearised(*[array[rows] for array in self.linearised])
        said = Constraints(self.said.residuals[rows], self.said.H[rows], self.said.dof[rows])
        return Heard(self.track_ids[rows], self.seen[rows], self.points[rows], linearised, said)

    def joined(self, other: "Heard") -> "Heard":
        """Return both together."""
        linearised = Linearised(*[np.concatenate(pair) for pair in zip(self.linearised, other.linearised, strict=True)])
        said = Constraints(
            np.concatenate([self.said.residuals, other.said.residuals]),
            np.concatenate([self.said.H, other.said.H]),
            np.concatenate([self.said.dof, other.said.dof]),
        )
        ids, seen = np.concatenate([self.track_ids, other.track_ids]), np.concatenate([self.seen, other.seen])
        return Heard(ids, seen, np.concatenate([self.points, other.points]), linearised, said)


class TrackGate:
    """Tests tracks against a joint belief at the 95 % quantile."""

    def __init__(self, joint: JointBelief, at: Linearisation, rig: StereoRig) -> None:
        self._joint, self._at, self._rig = joint, at, rig

    def passed(self, sightings: Sightings, innovation: Innovation) -> Heard:
        """Return the tracks that pass, some of them after giving up a sighting.

        ``innovation`` counts what was used, and a track tested as many times as it asked.
        """
        heard, slipped = self._asked(sightings, innovation)
        again = slipped.select(slipped.seen.sum(axis=1) >= FEWEST_SIGHTINGS)
        return heard.joined(self._asked(again, innovation)[0]) if len(again.track_ids) else heard

    def _asked(self, sightings: Sightings, innovation: Innovation) -> tuple[Heard, Sightings]:
        """Return the tracks that pass as they are, and those that have slipped without their worst sighting."""
        joint = self._joint
        points, reliable = triangulate(sightings.uvs_px, sightings.seen, joint.clones, self._rig)
        sightings, points = sightings.select(reliable), points[reliable]
        linearised = multiview.linearise(sightings, points, joint.clones, self._at.clones(joint), self._rig)
        said = multiview.without_landmark(linearised, sightings.seen)
        precision = self._precision(said)
        nis = np.einsum("fi,fij,fj->f", said.residuals, precision, said.residuals)
        accepted = np.asarray(nis < gate_at(said.dof))
        innovation.add(nis, said.dof, accepted)
        heard = Heard(sightings.track_ids, sightings.seen, points, linearised, said)
        slipped = np.asarray(nis > SLIPPED_FACTOR * gate_at(said.dof))
        worst = _worst_sighting(heard.select(slipped), precision[slipped], sightings.seen[slipped])
        seen = sightings.seen[slipped].copy()
        seen[np.arange(len(worst)), worst] = False
        return heard.select(accepted), sightings.select(slipped)._replace(seen=seen)

    def _precision(self, said: Constraints) -> Array:
        """Return the inverse of the covariance (F, 3W - 3, 3W - 3) of what each track says."""
        P = self._joint.cov[self._joint.clone_columns, self._joint.clone_columns]
        spread = said.H @ P @ np.swapaxes(said.H, 1, 2)
        return np.asarray(np.linalg.inv(spread + np.eye(spread.shape[1])))


def _worst_sighting(heard: Heard, precision: Array, seen: BoolArray) -> IntArray:
    """Return the sighting (F,) of each track without which its NIS would be least.

    Leaving out a sighting is letting it be anything: with ``W`` the precision of all coordinates and ``r`` their
    residuals, the NIS falls by ``(W r)_j^T W_jj^-1 (W r)_j``.
    """
    tracks, window = seen.shape
    basis = multiview.null_space(heard.linearised)
    weighted = np.einsum("frw,frs,fs->fw", basis, precision, heard.said.residuals).reshape(tracks, window, 3)
    blocks = basis.reshape(tracks, 3 * window - 3, window, 3)
    own = np.einsum("frwi,frs,fswj->fwij", blocks, precision, blocks)
    own = np.where(seen[..., None, None], own, np.eye(3))
    fall = np.einsum("fwi,fwi->fw", weighted, np.linalg.solve(own + 1e-12 * np.eye(3), weighted[..., None])[..., 0])
    return np.asarray(np.argmax(np.where(seen, fall, -1.0), axis=1))
