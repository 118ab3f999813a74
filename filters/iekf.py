"""Joint EKF in the right-invariant error whose updates are iterated to convergence (Bell & Cathey 1993).

What it approximates: as `riekf`, but a frame corrects to the most probable state given the prediction, not to the end
of one Gauss-Newton step. The prediction stays Gaussian and past sightings stay linearised where they were, so it begins
to matter in which coordinates the prediction is Gaussian: iterated over landmarks in metres, the mean is biased along
their depth (NEES of the pose 3 to 9 in flight and on the road, where one step has 1), with Jacobians of the covariance
at first estimates even more. Landmarks move along their inverse depth from the camera that saw them first, as in
`riekf`: in that a stereo sighting is linear. The covariance is that of the right-invariant error, reduced by Jacobians
at the corrected estimate: global position and heading stay as unknown as they were.
"""

from functools import partial

from filters.kalman import iterated
from filters.kalman.invariant import AnchoredBelief
from filters.kalman.joint_ekf import JointEkf
from filters.kalman.linearisation import AtLatestEstimates
from filters.kalman.online_output import OnlineOutput
from toolkit.estimator import Estimator, Setup

CITES = ("bell1993iterated", "barrau2017invariant")
RUNG, CHANGE = 50, "+ iterated update"
RULES = {"tracks": "a landmark in its state has no state for the error of its track"}


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    belief = partial(AnchoredBelief, T_imu_cam=setup.rig.T_imu_cam)
    return OnlineOutput(JointEkf(setup, AtLatestEstimates(), belief, iterated.correct))
