"""Joint EKF in the right-invariant error, Jacobians at the latest estimates (Barrau & Bonnabel 2015, 2017).

What it approximates: as in `ekf-slam`, past poses and landmarks out of view are marginalised at once. `ekf-slam` keeps
its Jacobians at first estimates, however poor these were, so as not to gain information on the heading, which no
measurement observes. Here pose, velocity and landmarks are one element of a Lie group and share one rotation error. A
translation or rotation of the world is then the same error vector at every estimate, and the Jacobians are zero along
it wherever they are evaluated. They can therefore be evaluated at the latest estimates. Only the biases are outside the
group, and only through them does the propagation of the error depend on the estimate.

A landmark is anchored in the camera that first saw it, and is parametrised by its inverse depth from there. What
remains approximate: an update is one Gauss-Newton step.
"""

from functools import partial

from filters.ekf_slam import JointEkf
from filters.kalman.coordinates import AnchoredBelief
from filters.kalman.joint import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from toolkit.estimator import Estimator, Setup

CITES = ("barrau2015ekf", "barrau2017invariant")
RUNG, CHANGE = 40, "+ right-invariant error, Jacobians at latest estimates, anchors"
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "invariant error",
    "inverse depth",
    "long-lived landmarks",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}}


def build(setup: Setup) -> Estimator:
    belief = partial(AnchoredBelief, T_imu_cam=setup.rig.T_imu_cam)
    return OnlineOutput(JointEkf(setup, AtLatestEstimates(), belief))
