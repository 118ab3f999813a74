"""What to do when GTSAM finds a system indeterminate, which variable it names, and what makes a landmark one.

GTSAM's stereo factor has no gradient where its landmark is behind the camera. A landmark that is seen at too small a
disparity first and at larger ones next is moved by a Gauss-Newton step in metres, taken with the slope of depth at the
small disparity: it passes the camera where the right disparity is more than twice the first. Linearised there the
landmark would be indeterminate.

GTSAM also refuses a clique whose own variables, scaled to a unit diagonal, have a condition beyond 7e7. An IMU ties two
states of neighbouring frames so well, and the world after a minute of driving so loosely, that both in one clique are
beyond it; and the last two eliminated always are in one, for the one before the last hangs on all that is left. So the
newest state is followed by a variable that means nothing and that only this state is tied to, by factors that weigh
nothing.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.estimate import Trajectory
from toolkit.geometry import Array, BoolArray, se3_inverse, transform
from toolkit.models.factors import kind_of
from toolkit.models.motion import MotionModel
from toolkit.models.state_covariances import RoundingError, state_covs
from toolkit.sequence import StereoRig

# What holds a variable that nothing else determines: m of a landmark; rad, m, m/s of a state.
WEAK_SIGMA = 1.0
# The condition of a landmark's information, scaled to a unit diagonal, beyond which GTSAM refuses it.
MOST_CONDITION = 7e7
# The variable that is eliminated last.
LAST = gtsam.symbol("r", 0)


class Recovery(NamedTuple):
    """What had to be recovered, a line each, and the track ids of the landmarks that were dropped for it."""

    log: list[str]
    dropped: set[int]


def behind_camera(points: Array, T_world_imu: Array, rig: StereoRig) -> BoolArray:
    """Say which points (N, 3) m in the world are not in front of the camera of a pose (4, 4)."""
    T_cam_world = se3_inverse(T_world_imu @ rig.T_imu_cam)
    return np.asarray(transform(T_cam_world, points)[:, 2] <= 0.0)


def variable_named(refusal: RuntimeError) -> int:
    """Return the key of the variable GTSAM says it was working near; any other refusal is raised again."""
    named = re.search(r"near variable\s+(\d+)", str(refusal))
    if named is None:
        raise refusal
    return int(named.group(1))


def undetermined(factors: gtsam.NonlinearFactorGraph, at: gtsam.Values) -> list[int]:
    """Return the landmarks whose factors do not determine them, of a graph without empty slots.

    GTSAM names the first variable of a clique, which need not be the one that makes it indeterminate, and of many one
    at a time.
    """
    return [key for key, condition in landmark_conditions(factors, at).items() if not condition <= MOST_CONDITION]


def landmark_conditions(factors: gtsam.NonlinearFactorGraph, at: gtsam.Values) -> dict[int, float]:
    """Return the condition of the information that factors have of each landmark, scaled to a unit diagonal.

    That of one which went thousands of baselines away is beyond what GTSAM allows: its depth is not determined.
    """
    linear, information = factors.linearize(at), dict[int, Array]()
    size_of = {key: at.extract([key]).dim() for key in set(linear.keys())}
    for factor in (linear.at(i) for i in range(linear.size())):
        keys: list[int] = factor.keys()
        if any(kind_of(key) == "l" for key in keys):
            of_all, ends = factor.information(), np.cumsum([size_of[key] for key in keys])
            for key, end in zip(keys, ends.tolist(), strict=True):
                if kind_of(key) == "l":
                    information[key] = information.get(key, 0.0) + of_all[end - 3 : end, end - 3 : end]
    return {key: float(np.linalg.cond(_scaled(information[key]))) for key in sorted(information)}


def _scaled(information: Array) -> Array:
    root = np.sqrt(np.diag(information))
    root[root == 0.0] = 1.0
    return np.asarray(information / np.outer(root, root))


def weak_hold(key: int, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """Return a factor that holds a variable loosely at its value."""
    at = values.extract([key])
    size = at.dim()
    noise = gtsam.noiseModel.Isotropic.Sigma(size, WEAK_SIGMA)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(key, np.eye(size), np.zeros(size), noise), at)


def ties_of_the_last(state: Mapping[int, int]) -> gtsam.NonlinearFactorGraph:
    """Return the factors that tie the last variable to a state, whose keys have sizes, and tell nothing of it."""
    ties, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(1)
    for key, size in state.items():
        tie = gtsam.JacobianFactor(LAST, np.eye(1), key, np.zeros((1, size)), np.zeros(1), unit)
        ties.add(gtsam.LinearContainerFactor(tie))
    return ties


def without_gaps(factors: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a graph whose slots may be empty."""
    compact = gtsam.NonlinearFactorGraph()
    for slot in range(factors.size()):
        if factors.exists(slot):
            compact.add(factors.at(slot))
    return compact


def with_covariances(
    trajectory: Trajectory, linear: gtsam.GaussianFactorGraph, motion: MotionModel
) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the trajectory with the covariance of every state, or as it is and the reason."""
    try:
        covs = state_covs(linear, motion, trajectory.T_world_imu)
    except RuntimeError as refusal:
        return trajectory, (no_covariances(refusal),)
    return replace(trajectory, cov=covs), ()


def no_covariances(refusal: RuntimeError) -> str:
    """Return why there are no covariances where GTSAM refuses; another refusal is raised again."""
    if isinstance(refusal, RoundingError):
        return f"no covariances of the final states: {refusal}"
    name = gtsam.Symbol(variable_named(refusal)).string()
    return f"no covariances of the final states: the graph leaves {name} undetermined"
