"""Joint EKF of the pose and the landmarks in view, all cross-covariances kept (Smith, Self & Cheeseman 1990).

The gauge: in world coordinates a joint EKF evaluates the Jacobians of one landmark at ever new estimates, which
together reduce the variance of its heading, though nothing measures it. Here every Jacobian is taken at first
estimates, with which global position and heading stay exactly unobservable (Huang, Mourikis & Roumeliotis 2010).

What is left: a first estimate is one stereo sighting, however poor. Where its depth is known to a tenth or less and
tracks last, Jacobians at it are wrong for as long: on drives with an IMU, thirty tracks that are never lost and 2 px of
noise it was 2.9 to 5.6 times as far off as `riekf`, with a NEES of 12 to 140 (four draws); with the hundred tracks of
`drive-imu`, of which one in twenty is lost a frame, its NEES is 3.9. Starting landmarks only once their depth is known
better helps no more than it costs in landmarks.

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
RUNG, CHANGE = 30, "+ cross-covariances, first estimates, inverse depth, by share, IMU matched; no loss"
RULES = {"tracks": "a landmark in its state has no state for the error of its track", "match_tracks": True}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    belief = partial(InverseDepthBelief, T_imu_cam=setup.rig.T_imu_cam)
    correlation = LandmarkCorrelation.of(setup)
    return OnlineOutput(JointEkf(setup, AtFirstEstimates(), belief, correlation=correlation))
