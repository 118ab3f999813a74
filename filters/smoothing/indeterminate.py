"""Recovery where GTSAM finds a system indeterminate: which variable it names, and how a landmark becomes one.

GTSAM's stereo factor has no gradient where its landmark is behind the camera. Suppose a landmark is first seen at too
small a disparity and then at larger ones. A Gauss-Newton step in metres uses the slope of depth at the small disparity,
and moves the landmark behind the camera if the right disparity is more than twice the first. Linearised there, the
landmark would be indeterminate.

GTSAM also refuses a clique whose own variables, scaled to a unit diagonal, have a condition number beyond 7e7. An IMU
ties the states of neighbouring frames so tightly, and after a minute of driving the world is known so loosely, that two
states in one clique exceed it. The last two variables eliminated are always in one clique, because the one before the
last depends on all that remains. So the newest state is followed by a dummy variable that is tied to this state alone,
by factors with negligible weight.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.estimate import Trajectory
from toolkit.geometry import Array
from toolkit.models.factors import kind_of
from toolkit.models.graph_state import MotionModel
from toolkit.models.state_covariances import RoundingError, state_covs

# Sigma of the prior on a variable that nothing else determines: m for a landmark; rad, m, m/s for a state.
WEAK_SIGMA = 1.0
# As an angle, seen from the nearest pose, a landmark's is this at least: far more than any direction or attitude is
# uncertain, and little enough that GTSAM accepts the landmark, whose direction may be known to 1e-4 rad.
WEAK_ANGLE_RAD = 0.1
# The condition number of a landmark's information, scaled to a unit diagonal, beyond which GTSAM refuses it.
MOST_CONDITION = 7e7
# The dummy variable, which is eliminated last.
LAST = gtsam.symbol("r", 0)


class Recovery(NamedTuple):
    """A log line for each recovery, and the track ids of the landmarks that were dropped."""

    log: list[str]
    dropped: set[int]

    def after(self, why: Mapping[int, str]) -> "Recovery":
        """Return the recovery with the landmarks whose drop, each for its reason, it followed."""
        lines = [f"landmark {i} {reason} and was dropped" for i, reason in sorted(why.items())]
        return Recovery(lines + self.log, why.keys() | self.dropped)


def variable_named(refusal: RuntimeError) -> int:
    """Return the key of the variable near which GTSAM reports the failure; any other error is raised again."""
    named = re.search(r"near variable\s+(\d+)", str(refusal))
    if named is None:
        raise refusal
    return int(named.group(1))


def undetermined(factors: gtsam.NonlinearFactorGraph, at: gtsam.Values) -> list[int]:
    """Return the landmarks that their own factors do not determine; the graph must have no empty slots.

    GTSAM names the first variable of a clique, which need not be the indeterminate one, and it names one at a time. The
    depth of a landmark thousands of baselines away is not determined.
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
    return [key for key in sorted(information) if not np.linalg.cond(_scaled(information[key])) <= MOST_CONDITION]


def _scaled(information: Array) -> Array:
    root = np.sqrt(np.diag(information))
    root[root == 0.0] = 1.0
    return np.asarray(information / np.outer(root, root))


def weak_prior(key: int, values: gtsam.Values) -> gtsam.NonlinearFactor:
    """Return a weak prior on a variable at its value; the values have the poses that saw it, if it is a landmark.

    A prior of a metre would determine the direction of a landmark many kilometres away better than its sightings do,
    and with it all attitudes.
    """
    at = values.extract([key])
    size, sigma = at.dim(), WEAK_SIGMA
    if kind_of(key) == "l":
        sigma = max(sigma, WEAK_ANGLE_RAD * _least_distance_m(at.atPoint3(key), values))
    noise = gtsam.noiseModel.Isotropic.Sigma(size, sigma)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(key, np.eye(size), np.zeros(size), noise), at)


def _least_distance_m(point: Array, values: gtsam.Values) -> float:
    """Return the distance of a point (3,) from the nearest of all poses, 0 without any."""
    poses = gtsam.utilities.allPose3s(values)
    places = [poses.atPose3(key).translation() for key in poses.keys()]  # noqa: SIM118 - not a mapping
    return min((float(np.linalg.norm(point - place)) for place in places), default=0.0)


def with_the_last_tied(
    tree: gtsam.ISAM2, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, newest: Mapping[int, int]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return what is added to a tree, and the dummy variable tied to the newest state (keys with sizes).

    There is one such factor for each of the keys, at the end, without information on the state.
    """
    factors, values = gtsam.NonlinearFactorGraph(factors), gtsam.Values(values)
    if not tree.valueExists(LAST):
        values.insert(LAST, np.zeros(1))
    for key, size in newest.items():
        unit = gtsam.noiseModel.Unit.Create(1)
        tie = gtsam.JacobianFactor(LAST, np.eye(1), key, np.zeros((1, size)), np.zeros(1), unit)
        factors.add(gtsam.LinearContainerFactor(tie))
    return factors, values


def without_gaps(factors: gtsam.NonlinearFactorGraph, but: int | None = None) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a tree without its empty slots and, if it is given, without those on a variable."""
    compact = gtsam.NonlinearFactorGraph()
    for slot in range(factors.size()):
        if factors.exists(slot) and (but is None or but not in list(factors.at(slot).keys())):
            compact.add(factors.at(slot))
    return compact


def with_covariances(
    trajectory: Trajectory, linear: gtsam.GaussianFactorGraph, motion: MotionModel
) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the trajectory with the covariance of every state, or unchanged with the reason."""
    try:
        return replace(trajectory, cov=state_covs(linear, motion, trajectory.T_world_imu)), ()
    except RoundingError as refusal:
        return trajectory, (f"no covariances of the final states: {refusal}",)
    except RuntimeError as refusal:
        name = gtsam.Symbol(variable_named(refusal)).string()
        return trajectory, (f"no covariances of the final states: the graph leaves {name} undetermined",)
