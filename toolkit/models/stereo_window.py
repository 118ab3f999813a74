"""A window of states with motion factors and a linear prior, and tracks whose landmarks are no variables.

A :class:`StereoWindow` is the problem, a :class:`TrackedWindow` adds the track id of each point, and :class:`Evaluated`
computes the normal equations, which ``window_solver`` solves. A fixed-lag smoother solves it frame by frame, the
measurement of noise on stretches of a recording. Everything is dense: a window has a few hundred unknowns.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import cholesky

from toolkit.geometry import Array, IntArray
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.reduced_vision import ReducedVision, RobustCamera, Sightings, Vision, seen_from


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """Information matrix (D, D) and vector (D,) on the first D unknowns of the window, linearised at ``about``."""

    information: Array
    vector: Array
    about: gtsam.Values

    @classmethod
    def nothing(cls) -> "MarginalPrior":
        """Return a prior without information."""
        return cls(np.zeros((0, 0)), np.zeros(0), gtsam.Values())


@dataclass(frozen=True, eq=False)
class StereoWindow:
    """States in the order of time: their keys (each [pose, velocity, bias] or [pose, bias]), factors and sightings.

    ``motion[i]`` ties state i to the one before it; ``points`` (M, 3) are the landmarks of the sightings.
    """

    keys: tuple[tuple[int, ...], ...]
    values: gtsam.Values
    motion: tuple[gtsam.NonlinearFactorGraph, ...]
    prior: MarginalPrior
    sightings: Sightings
    points: Array

    @property
    def poses(self) -> Array:
        """Return the poses (K, 4, 4) of the IMU in the world."""
        return np.array([self.values.atPose3(keys[0]).matrix() for keys in self.keys])

    @property
    def all_keys(self) -> list[int]:
        """Return the keys of all states, in the order of the unknowns."""
        return [key for keys in self.keys for key in keys]

    @property
    def size(self) -> int:
        """Return the number of unknowns of one state."""
        return int(self.values.extract(list(self.keys[0])).dim())


@dataclass(frozen=True, eq=False)
class TrackedWindow:
    """A window and the track ids (M,) of its points."""

    window: StereoWindow
    track_ids: IntArray

    @classmethod
    def empty(cls) -> "TrackedWindow":
        """Return a window without states."""
        none = np.empty(0, dtype=np.int64)
        sightings = Sightings(none, none, np.empty((0, 3)))
        return cls(StereoWindow((), gtsam.Values(), (), MarginalPrior.nothing(), sightings, np.empty((0, 3))), none)

    def points_by_id(self) -> dict[int, Array]:
        """Return the point (3,) m of every track."""
        return dict(zip(self.track_ids.tolist(), self.window.points, strict=True))

    def seeing(self, frame: StereoFrame, T_world_imu: Array, rig: StereoRig) -> "TrackedWindow":
        """Add the sightings of the newest state, at a pose (4, 4): known tracks continue, new ones are triangulated.

        New tracks of too small a disparity are left out.
        """
        known = np.isin(frame.track_ids, self.track_ids)
        new = frame.select(~known & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        used = frame.select(known | np.isin(frame.track_ids, new.track_ids))
        ids = np.concatenate([self.track_ids, new.track_ids])
        points = np.concatenate([self.window.points, stereo.triangulate_world(new.uvs_px, T_world_imu, rig)])
        order = np.argsort(ids)
        rows, seen = order[np.searchsorted(ids, used.track_ids, sorter=order)], self.window.sightings
        newest = np.full(rows.size, len(self.window.keys) - 1)
        sightings = Sightings(
            np.concatenate([seen.pose, newest]),
            np.concatenate([seen.point, rows]),
            np.concatenate([seen.uv_px, used.uvs_px]),
        )
        return TrackedWindow(replace(self.window, points=points, sightings=sightings), ids)

    def newest(self, frame: StereoFrame) -> StereoFrame:
        """Return the newest state's frame without the sightings that are not in the window."""
        seen = self.window.sightings
        taken = self.track_ids[seen.point[seen.pose == len(self.window.keys) - 1]]
        return frame.select(np.isin(frame.track_ids, taken))

    def compacted(self) -> "TrackedWindow":
        """Drop the points without sightings."""
        seen = self.window.sightings
        kept, rows = np.unique(seen.point, return_inverse=True)
        sightings = Sightings(seen.pose, rows.astype(np.int64), seen.uv_px)
        return TrackedWindow(
            replace(self.window, points=self.window.points[kept], sightings=sightings), self.track_ids[kept]
        )

    def in_front(self, rig: StereoRig) -> tuple["TrackedWindow", IntArray]:
        """Drop the points that are behind a camera that saw them; return the window and the ids (n,) of these."""
        seen = self.window.sightings
        in_front = seen_from(self.window.poses, self.window.points, seen, rig).in_front
        behind = np.unique(seen.point[~in_front])
        if not behind.size:
            return self, self.track_ids[behind]
        left = seen.of_points(np.setdiff1d(seen.point, behind))
        return TrackedWindow(replace(self.window, sightings=left), self.track_ids).compacted(), self.track_ids[behind]


@dataclass(frozen=True, eq=False)
class System:
    """The normal equations (D, D), (D,) of a window and the elimination of its landmarks."""

    information: Array
    vector: Array
    vision: ReducedVision

    @cached_property
    def root(self) -> Array:
        """The lower Cholesky factor (D, D) of the information; raises LinAlgError where there is none."""
        return _lower_factor(self.information)

    def damped_root(self, damping: float) -> Array:
        """Return the lower Cholesky factor (D, D) with a share of the diagonal added; raises as ``root`` does."""
        if damping == 0.0:
            return self.root
        damped = self.information.copy()
        damped.flat[:: len(damped) + 1] *= 1.0 + damping
        return _lower_factor(damped)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A window and its cost at its values: half the squared errors of motion and prior, and Huber's losses."""

    window: StereoWindow
    motion: gtsam.GaussianFactorGraph
    off_prior: Array
    vision: Vision

    @classmethod
    def of(cls, window: StereoWindow, camera: RobustCamera) -> "Evaluated":
        """Evaluate a window. Its motion is linearised at once: Python factors cost as much to evaluate."""
        vision = Vision.at(window.poses, window.points, window.sightings, camera)
        return cls(window, _joined_graph(window.motion).linearize(window.values), _off_prior(window), vision)

    @cached_property
    def error(self) -> float:
        """The cost of the window."""
        prior, off = self.window.prior, self.off_prior
        of_prior = float(0.5 * off @ prior.information @ off - prior.vector @ off)
        return of_prior + float(self.motion.error(self.window.values.zeroVectors())) + self.vision.loss

    def linearised(self) -> System:
        """Return the normal equations."""
        window, count, size = self.window, len(self.window.keys), len(self.off_prior)
        d = window.size
        information, vector = self._of_motion(count * d)
        information[:size, :size] += window.prior.information
        vector[:size] += window.prior.vector - window.prior.information @ self.off_prior
        vision = self.vision.reduced()
        information.reshape(count, d, count, d)[:, :6, :, :6] += vision.information.reshape(count, 6, count, 6)
        vector.reshape(count, d)[:, :6] += vision.vector.reshape(count, 6)
        return System(information, vector, vision)

    def _of_motion(self, size: int) -> tuple[Array, Array]:
        """Return the normal equations of the motion factors, which involve the first states of the window, or all."""
        tied, ordering = set(self.motion.keyVector()), gtsam.Ordering()
        for key in self.window.all_keys:
            if key in tied:
                ordering.push_back(key)
        information, vector = np.zeros((0, 0)), np.zeros(0)
        if tied:
            # The matrix is symmetric and column-major, so its transpose is the same matrix in NumPy's row-major order.
            augmented = self.motion.augmentedHessian(ordering).T
            information, vector = augmented[:-1, :-1], augmented[-1, :-1]
        rest = size - len(vector)
        return (information, vector) if rest == 0 else (np.pad(information, (0, rest)), np.pad(vector, (0, rest)))


def _joined_graph(graphs: Iterable[gtsam.NonlinearFactorGraph]) -> gtsam.NonlinearFactorGraph:
    whole = gtsam.NonlinearFactorGraph()
    for graph in graphs:
        whole.push_back(graph)
    return whole


def _off_prior(window: StereoWindow) -> Array:
    """Return the deviation (D,) of the prior's states from its linearisation point."""
    about = window.prior.about
    keys = [key for key in window.all_keys if about.exists(key)]
    if not keys:
        return np.zeros(0)
    delta = about.localCoordinates(window.values.extract(keys))
    return np.concatenate([delta.at(key) for key in keys])


def _lower_factor(matrix: Array) -> Array:
    # LAPACK is column-major and NumPy row-major: a symmetric matrix is its own transpose and need not be copied.
    return np.asarray(cholesky(matrix.T, lower=True, check_finite=False))
