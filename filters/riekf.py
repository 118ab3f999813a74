"""Joint EKF in the right-invariant error, Jacobians at the latest estimates (Barrau & Bonnabel 2015, 2017).

What it approximates: as in `ekf-slam`, past poses and landmarks out of view are marginalised at once. There the
Jacobians stay at first estimates, however poor those were, so as not to gain information on a heading that nothing
measures. Here pose, velocity and landmarks are one element of a Lie group and share one rotation error: to move or to
turn the world is the same error at every estimate, the Jacobians are blind to it wherever they are taken, and so they
may be taken at the latest estimates. Only the biases are outside the group, and only through them does the propagation
of the error depend on what is estimated.

A landmark is in the group by its anchor, the camera that saw it first, and moves along its inverse depth from there. In
metres the squared position error was 2.2 times what it is on drive-imu, and 1.3 times in flight. What is left: an
update is one Gauss-Newton step, and a landmark's first estimate one stereo sighting whose depth is not Gaussian.

Beside an IMU, landmarks whose residuals are correlated count for less (:mod:`filters.kalman.residual_correlation`):
the position error was 0.73 +- 0.06 times what it is in full on six draws of `flight-realistic`. Beside odometry they
count in full: over seven drives and two draws the error would be 0.85 +- 0.08 times that, and the NEES a sixth, but on
one of the drives the error would be half as much again.
"""

from functools import partial

from filters.kalman.invariant import AnchoredBelief
from filters.kalman.joint_ekf import JointEkf
from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from filters.kalman.residual_correlation import LandmarkCorrelation
from toolkit.estimator import Estimator, Setup

CITES = ("barrau2015ekf", "barrau2017invariant")
RUNG, CHANGE = 40, "+ right-invariant error, latest Jacobians, anchors that move with pose; share by IMU"
RULES = {
    "tracks": "a landmark in its state has no state for the error of its track",
    "match_tracks": ("imu",),
}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    belief = partial(AnchoredBelief, T_imu_cam=setup.rig.T_imu_cam)
    correlation = LandmarkCorrelation.of(setup) if setup.motion_kind == "imu" else None
    return OnlineOutput(JointEkf(setup, AtLatestEstimates(), belief, correlation=correlation))
