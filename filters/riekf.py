"""Joint EKF in the right-invariant error, Jacobians at the latest estimates (Barrau & Bonnabel 2015, 2017).

What it approximates: as in `ekf-slam`, past poses and landmarks out of view are marginalised at once. There the
Jacobians stay at first estimates, however poor those were, so as not to gain information on a heading that nothing
measures. Here pose, velocity and landmarks are one element of a Lie group and share one rotation error: to move or to
turn the world is the same error at every estimate, the Jacobians are blind to it wherever they are taken, and so they
may be taken at the latest estimates. Only the biases are outside the group, and only through them does the propagation
of the error depend on what is estimated.
"""

from filters.kalman.invariant import InvariantBelief
from filters.kalman.joint_ekf import JointEkf
from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from toolkit.estimator import Estimator, Setup

RUNG, CHANGE = 40, "+ right-invariant error, latest Jacobians"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return OnlineOutput(JointEkf(setup, AtLatestEstimates(), InvariantBelief))
