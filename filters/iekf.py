"""Joint EKF in the right-invariant error whose updates are iterated to convergence (Bell & Cathey 1993).

What it approximates: as `riekf`, but a frame corrects to the most probable state given the prediction instead of taking
one Gauss-Newton step. The prediction stays Gaussian and past sightings stay linearised where they were. It therefore
matters in which coordinates the prediction is Gaussian: iterated over landmarks in metres, the mean would be biased
along their depth. Landmarks are therefore parametrised by inverse depth from the camera that first saw them, as in
`riekf`; in these coordinates a stereo sighting is linear. The covariance is that of the right-invariant error, reduced
with Jacobians at the corrected estimate, so that global position and heading stay unobservable.

The update is Gauss-Newton to the most probable state given the prediction and one frame. An EKF update is the first
step of that iteration; every further step linearises where the one before it ended (Bell & Cathey 1993, "The iterated
Kalman filter update as a Gauss-Newton method"; on a group Bourmaud, Mégret, Giremus & Berthoumieu 2016, "From intrinsic
optimization to iterated extended Kalman filtering on Lie groups"). A correction ``delta`` is represented as ``P pull``:
its cost under the prediction is ``delta . pull``, and the covariance P is never inverted.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from filters.ekf_slam import JointEkf
from filters.kalman.coordinates import AnchoredBelief
from filters.kalman.joint import (
    AtLatestEstimates,
    JointBelief,
    LandmarkSightings,
    Linearisation,
    covs_with_state,
    innovation,
    linearise_sightings,
    weighed,
)
from filters.kalman.online_output import OnlineOutput
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models.gating import FrameGate

CITES = ("bell1993iterated", "barrau2017invariant")
RUNG, CHANGE = 50, "+ iterated update"
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "invariant error",
    "inverse depth",
    "long-lived landmarks",
    "relinearisation",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}}
# Length of a step in standard deviations of the updated state.
NEGLIGIBLE_STEP = 1e-4
MOST_STEPS, MOST_HALVINGS = 10, 6


def build(setup: Setup) -> Estimator:
    belief = partial(AnchoredBelief, T_imu_cam=setup.rig.T_imu_cam)
    return OnlineOutput(JointEkf(setup, AtLatestEstimates(), belief, correct))


class Iterate(NamedTuple):
    """A correction (n,), the ``pull`` (k,) that yields it, the sightings linearised there, and the total cost."""

    delta: Array
    pull: Array
    seen: LandmarkSightings
    cost: float


def correct(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them.

    The gate tests once, at the prediction, and Huber's weights are computed there. The covariance is reduced with
    Jacobians at the corrected estimate. An iteration that does not converge ends at the lowest cost it has reached;
    where not even the first step lowered the cost, the frame corrects nothing.
    """
    if not len(joint.landmark_ids):
        return
    assert isinstance(joint, AnchoredBelief)
    seen = linearise_sightings(joint, frame, at, rig)
    weights = weighed(joint, seen, covs_with_state(joint, seen), gate)
    if not weights.any():
        return
    measurement = Measurement(joint, frame, at, rig, weights)
    best, converged = most_probable(measurement)
    gate.unconverged += not converged
    if converged or best.pull.any():
        joint.move(best.delta)
        cross_covs = covs_with_state(joint, best.seen)
        joint.reduce_covariance(*innovation(joint, best.seen, cross_covs, weights)[:2])


@dataclass(frozen=True, eq=False)
class Measurement:
    """A prediction, the frame that corrects it, and the weights (L,) of the frame's landmarks."""

    prediction: AnchoredBelief
    frame: StereoFrame
    at: Linearisation
    rig: StereoRig
    weights: Array

    @property
    def part(self) -> slice:
        """Return the columns of the k errors that a sighting depends on: those of landmarks and clones."""
        return slice(self.prediction.landmark_columns.start, self.prediction.cov.shape[0])

    def after(self, pull: Array) -> Iterate:
        """Return the correction that a pull (k,) yields."""
        delta = self.prediction.cov[:, self.part] @ pull
        seen = linearise_sightings(self.prediction.displaced(delta), self.frame, self.at, self.rig)
        prior = delta[self.part] @ pull
        in_front = (seen.depth_m[self.weights > 0.0] > 0.0).all()
        cost = float(prior + self.weights @ np.square(seen.residuals).sum(axis=1)) if in_front else np.inf
        return Iterate(delta, pull, seen, cost)

    def step(self, now: Iterate) -> tuple[Array, float]:
        """Return the step (k,) of the pull to the minimum of the cost linearised at an iterate, and its length.

        That is the length of the resulting correction, in standard deviations after the update.
        """
        P = self.prediction.cov[self.part, self.part]
        H_pose, H_point = self.prediction.pulled_back(now.delta, now.seen.H_pose, now.seen.H_point)
        H, residuals = self.stacked(now.seen._replace(H_pose=H_pose, H_point=H_point))
        carried = H @ P
        innovation_cov = H @ carried.T
        innovation_cov.flat[:: len(carried) + 1] += 1.0
        pull = H.T @ cho_solve(cho_factor(innovation_cov), residuals + H @ now.delta[self.part]) - now.pull
        # |step|^2 in the metric P^-1 + H^T H
        return pull, float(np.sqrt(max(pull @ P @ pull, 0.0) + np.square(carried @ pull).sum()))

    def stacked(self, seen: LandmarkSightings) -> tuple[csr_array, Array]:
        """Return the Jacobian (m, k) and the residuals (m,) of the landmarks with non-zero weight, stacked."""
        rows, roots = np.flatnonzero(self.weights), np.sqrt(self.weights[self.weights > 0.0])[:, None, None]
        k = self.part.stop - self.part.start
        own = np.concatenate([3 * rows[:, None] + np.arange(3), np.tile(np.arange(k - 6, k), (len(rows), 1))], axis=1)
        blocks = roots * np.concatenate([seen.H_point[rows], seen.H_pose[rows]], axis=2)
        places, ends = np.repeat(own, 3, axis=0).ravel(), np.arange(0, blocks.size + 1, 9)
        H = csr_array((blocks.ravel(), places, ends), (3 * len(rows), k))
        return H, (roots[..., 0] * seen.residuals[rows]).ravel()


def most_probable(measurement: Measurement) -> tuple[Iterate, bool]:
    """Iterate from the prediction, taking only steps that lower the cost, until a step is negligible.

    Return the correction of lowest cost that was found, and whether the iteration converged.
    """
    now = measurement.after(np.zeros(measurement.part.stop - measurement.part.start))
    for _ in range(MOST_STEPS):
        step, length = measurement.step(now)
        if length < NEGLIGIBLE_STEP:
            return measurement.after(now.pull + step), True
        shortened = (measurement.after(now.pull + 0.5**halvings * step) for halvings in range(MOST_HALVINGS + 1))
        lower = next((then for then in shortened if then.cost < now.cost), None)
        if lower is None:
            break
        now = lower
    return now, False
