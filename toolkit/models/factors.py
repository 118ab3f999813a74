"""Parts that all graphs share: the keys, the stereo measurement as factors, priors, and marginal covariances."""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from math import isnan
from typing import Any, Protocol

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo

X, V, B, L = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B, gtsam.symbol_shorthand.L)
# A key is a character above an index of this many bits (gtsam/inference/Symbol.h); making a Symbol takes several times
# as long as the arithmetic here.
_INDEX_BITS = 56
_FIRST_LANDMARK = ord("l") << _INDEX_BITS
# GTSAM's Python wraps linear factors on up to this many variables; for more, only conditionals, which are factors too.
_MOST_TERMS = 3


def kind_of(key: int) -> str:
    """Return the kind of variable of a key: "x" a pose, "v" a velocity, "b" a bias, "l" a landmark."""
    return chr(key >> _INDEX_BITS)


def constant_bias(bias: Array) -> gtsam.imuBias.ConstantBias:
    """Return GTSAM's value for a bias (6,) [accel, gyro]."""
    return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])


def landmark_keys(track_ids: Iterable[int]) -> list[int]:
    return [_FIRST_LANDMARK + track_id for track_id in track_ids]


def key_list(keys: Iterable[int]) -> gtsam.KeyList:
    """Return keys in the form that updates of GTSAM's trees take."""
    listed = gtsam.KeyList()
    for key in keys:
        listed.push_back(key)
    return listed


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """Return the order in which variables are eliminated, or their rows are stacked."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def points_of(values: gtsam.Values, track_ids: Iterable[int]) -> dict[int, Array]:
    """Return the points (3,) of landmarks by track, rows of one array; raise RuntimeError where one has no value."""
    ascending = sorted(track_ids)
    points = gtsam.utilities.extractPoint3(values.extract(landmark_keys(ascending)))
    return dict(zip(ascending, points, strict=True))


def poses_of(values: gtsam.Values, frames: IntArray) -> Array:
    """Return the poses (N, 4, 4) X(k) of frames (N,), of which many may be the same: each is read once."""
    unique, row = np.unique(frames, return_inverse=True)
    return np.array([values.atPose3(X(k)).matrix() for k in unique.tolist()]).reshape(-1, 4, 4)[row]


# Makes a loss from its threshold in standard deviations.
Loss = Callable[[float], gtsam.noiseModel.mEstimator.Base]
HUBER: Loss = gtsam.noiseModel.mEstimator.Huber.Create
CAUCHY: Loss = gtsam.noiseModel.mEstimator.Cauchy.Create


class StereoFactors:
    """Makes one projection factor per sighting: the measurement, noise and extrinsic the filters use.

    A sighting that lacks the right image has a factor of the left camera, with two rows instead of three and the loss
    of the others. The factors have the rig's weight of tracks; ``threshold`` (None for no loss) of the ``loss`` is in
    standard deviations of the stated noise, as in the filters.
    """

    def __init__(self, rig: StereoRig, threshold: float | None = None, loss: Loss = HUBER) -> None:
        robust = None if threshold is None else loss(threshold * float(np.sqrt(rig.track_weight)))
        self._noise = _noise(rig.cov_uv_px2 / rig.track_weight, robust)
        self._left_noise = _noise(stereo.left_cov_px2(rig) / rig.track_weight, robust)
        self._calibration = gtsam.Cal3_S2Stereo(rig.fx_px, rig.fy_px, 0.0, rig.cx_px, rig.cy_px, rig.baseline_m)
        self._left_calibration = gtsam.Cal3_S2(rig.fx_px, rig.fy_px, 0.0, rig.cx_px, rig.cy_px)
        self._T_imu_cam = gtsam.Pose3(rig.T_imu_cam)

    def of(self, frame: StereoFrame, k: int) -> Iterator[gtsam.NonlinearFactor]:
        """Yield the factors between the pose X(k) and the landmarks L(track id) the frame shows."""
        pose = X(k)
        for landmark, uv_px in zip(landmark_keys(frame.track_ids.tolist()), frame.uvs_px.tolist(), strict=True):
            if isnan(uv_px[1]):
                left = np.array([uv_px[0], uv_px[2]]), self._left_noise
                yield gtsam.GenericProjectionFactorCal3_S2(
                    *left, pose, landmark, self._left_calibration, self._T_imu_cam
                )
            else:
                both = gtsam.StereoPoint2(*uv_px), self._noise
                yield gtsam.GenericStereoFactor3D(*both, pose, landmark, self._calibration, self._T_imu_cam)


def _noise(cov_px2: Array, robust: gtsam.noiseModel.mEstimator.Base | None) -> gtsam.noiseModel.Base:
    gaussian = gtsam.noiseModel.Gaussian.Covariance(cov_px2)
    return gaussian if robust is None else gtsam.noiseModel.Robust.Create(robust, gaussian)


def joint_prior(at: gtsam.Values, keys: list[int], cov: Array) -> gtsam.NonlinearFactorGraph:
    """Return a prior on variables at their values, of a joint covariance (d, d) in GTSAM's tangent spaces."""
    root_information = np.linalg.inv(np.linalg.cholesky(cov))
    sizes = at.dims()
    columns = np.split(root_information, np.cumsum([sizes[key] for key in keys])[:-1], axis=1)
    graph = gtsam.NonlinearFactorGraph()
    linear = linear_factor(list(zip(keys, columns, strict=True)), np.zeros(len(cov)))
    graph.add(gtsam.LinearContainerFactor(linear, at))
    return graph


def linear_factor(terms: list[tuple[int, Array]], residual: Array) -> gtsam.JacobianFactor:
    """Return the linear factor of a whitened residual (m,) on variables, each with its key and Jacobian (m, d)."""
    unit = gtsam.noiseModel.Unit.Create(len(residual))
    if len(terms) <= _MOST_TERMS:
        arguments: Any = [*chain.from_iterable(terms), residual, unit]
        return gtsam.JacobianFactor(*arguments)
    return gtsam.JacobianFactor(gtsam.GaussianConditional(terms, len(terms), residual, unit))


class EliminatedGraph(Protocol):
    """An object with marginals: gtsam's ISAM2, GaussianBayesTree or Marginals."""

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:  # noqa: N802 - GTSAM's name
        """Return the joint marginal of some variables."""


def joint_cov(tree: EliminatedGraph, keys: list[int]) -> Array:
    """Return the joint covariance (d, d) of variables, in the order of the keys and in GTSAM's tangent spaces.

    Only the path from the variables to the root of the Bayes tree is used. For states that were eliminated last it is
    short, however long the graph (Kaess & Dellaert 2009). Raises RuntimeError, as GTSAM does, where the graph does not
    determine them.
    """
    cov = tree.jointMarginalCovariance(keys).fullMatrix()
    return np.asarray(0.5 * (cov + cov.T))


def python_factors(factors: gtsam.NonlinearFactorGraph) -> dict[int, gtsam.CustomFactor]:
    """Return the Python factors of a graph by their index in it."""
    places = ((i, factors.at(i)) for i in range(factors.size()))
    return {i: factor for i, factor in places if isinstance(factor, gtsam.CustomFactor)}
