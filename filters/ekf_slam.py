"""Joint EKF of the pose and the landmarks in view, all cross-covariances kept (Smith, Self & Cheeseman 1990).

The gauge: in world coordinates a joint EKF evaluates the Jacobians of one landmark at ever new estimates, which
together reduce the variance of its heading, though nothing measures it. Here every Jacobian is taken at first
estimates, with which global position and heading stay exactly unobservable (Huang, Mourikis & Roumeliotis 2010).

A first estimate is one stereo sighting, and may be poor. Beside an IMU a landmark that has moved from it by more than
0.3 of its distance starts anew, by the next sighting, and what the earlier ones said of all else stays. Over six draws
of 15 s that made the position error 0.75 +- 0.12 of what it was on `drive-imu` (NEES 3.0 -> 1.1), with thirty tracks
that are never lost and 2 px of noise 0.51 +- 0.21 there (NEES 18 -> 1.6) and 0.64 +- 0.22 on `flight`; between 0.2 and
0.4 the share hardly matters. Beside odometry, which tells how far landmarks come nearer, the start costs more than the
Jacobians do: real drives became 6 % worse. What is left: an update is one Gauss-Newton step with Jacobians that old.

Where residuals of landmarks turn out correlated under white noise, their sightings count for less
(:mod:`filters.kalman.residual_correlation`).
"""

from functools import partial

from filters.kalman.inverse_depth import InverseDepthBelief
from filters.kalman.joint_ekf import JointEkf
from filters.kalman.linearisation import AtFirstEstimates
from filters.kalman.online_output import OnlineOutput
from filters.kalman.residual_correlation import LandmarkCorrelation
from toolkit.estimator import Estimator, Setup

CITES = ("smith1990estimating", "huang2010observability")
RUNG, CHANGE = 30, "+ cross-covariances, first estimates or anew, inverse depth, share, matched"
RULES = {"tracks": "a landmark in its state has no state for the error of its track", "match_tracks": True}

# Of its distance, by which a landmark may have moved since its first estimate beside an IMU.
MOST_MOVED = 0.3


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    belief = partial(InverseDepthBelief, T_imu_cam=setup.rig.T_imu_cam)
    correlation = LandmarkCorrelation.of(setup)
    at = AtFirstEstimates(MOST_MOVED) if setup.motion_kind == "imu" else AtFirstEstimates()
    return OnlineOutput(JointEkf(setup, at, belief, correlation=correlation))
