"""Which parts of the filters run compiled, and how that is chosen: NumPy defines each part, a kernel computes the same.

A filter calls these functions when it is built, each with the compilation its run asked for
(:class:`toolkit.compilation.Compilation`). A function returns the NumPy definition, or a function of the same arguments
that calls a kernel. Kernels are imported only when they are used, because only they import numba.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from filters.kalman import multiview, track_gate, tracks_in_view, triangulation
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief, times_root, transposed_root_times, without_products
from filters.kalman.linearisation import Integrator
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import TestedTracks, TrackTest, WindowPoses
from filters.kalman.tracks_in_view import FollowedTracks, Information, RootedWindow
from toolkit.compilation import Compilation
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp
from toolkit.measured_motion import ImuMotion, ImuNoise, Motion, MotionNoise
from toolkit.models.gating import (
    FEWEST_SIGHTINGS,
    LEAST_DEPTH_M,
    LEAST_DISPARITY_PX,
    MISMATCHED_TRACK_FACTOR,
    huber_threshold,
)
from toolkit.models.imu import INTEGRATION_DENSITY, mean_noise_scale, transition_over
from toolkit.models.motion import Increment, MotionModel, motion_model
from toolkit.models.state import Belief, Prediction
from toolkit.models.stereo import StereoPrediction
from toolkit.sequence import StereoRig

_GATE_RULES = np.array(
    [
        triangulation.ITERATIONS,
        triangulation.FIRST_DAMPING,
        triangulation.RELATIVE_DECREASE,
        triangulation.ROUNDING,
        LEAST_DISPARITY_PX,
        LEAST_DEPTH_M,
        MISMATCHED_TRACK_FACTOR,
    ]
)
_KERNELS = "filters.kalman.kernels"
_EVEN_NOISE = np.empty((0, 2))
_DOF = np.array([3, 2])


def _kernel(compilation: Compilation, name: str) -> ModuleType | None:
    return compilation.module(f"{_KERNELS}.{name}")


def share_windowed(noise: MotionNoise, compilation: Compilation) -> None:
    """Let processes that start together share the compilation of the windowed filters' kernels, the longest first."""
    along_imu = ["preintegration"] if isinstance(noise, ImuNoise) else []
    compilation.share(f"{_KERNELS}.{name}" for name in ["track_gate", "corrections", "tracks_in_view", *along_imu])


def track_test(compilation: Compilation) -> TrackTest:
    """Return the function that tests tracks against a window: :func:`filters.kalman.track_gate.tested`."""
    kernel = _kernel(compilation, "track_gate")
    if kernel is None:
        return track_gate.tested

    def tested(sightings: TrackSightings, window: WindowPoses, rig: StereoRig, bounds: Array) -> TestedTracks:
        """Test tracks as the definition does; where right images are missing, the definition itself is called."""
        if sightings.left_only.any():
            return track_gate.tested(sightings, window, rig, bounds)
        points, reliable, nis, dof, worst, H, residuals, owners = kernel.test_tracks(
            _as_kernel_arrays((sightings.uvs_px, sightings.seen)),
            _as_kernel_arrays(window),
            _camera(rig),
            _GATE_RULES,
            bounds,
        )
        points = points[:-1]
        if not reliable.all():
            sightings, points = sightings.select(reliable), points[reliable]
            nis, dof, worst = nis[reliable], dof[reliable], worst[reliable]
        return TestedTracks(sightings, points, nis, dof, worst, H, residuals, owners)

    return tested


def steps_in_view(compilation: Compilation) -> tracks_in_view.Steps:
    """Return the functions of ``tracks_in_view`` that find the landmarks of tracks and the tracks' information."""
    kernel = _kernel(compilation, "tracks_in_view")
    if kernel is None:
        return tracks_in_view.NUMPY

    def followed(
        known: FollowedTracks, sightings: TrackSightings, joint: JointBelief, rig: StereoRig
    ) -> FollowedTracks:
        """Return tracks with their landmarks as the definition does, which is called where right images are missing."""
        if sightings.left_only.any():
            return tracks_in_view.followed(known, sightings, joint, rig)
        before = _as_kernel_arrays((known.sightings.track_ids, known.clone_frames, known.points, known.weights))
        now = _as_kernel_arrays((sightings.track_ids, joint.clone_frames, sightings.uvs_px, sightings.seen))
        found, points, weights = kernel.follow(
            before, now, np.ascontiguousarray(joint.clones), _camera(rig), FEWEST_SIGHTINGS, LEAST_DISPARITY_PX
        )
        return FollowedTracks(sightings, joint.clone_frames, points, weights).select(found)

    def information(tracks: FollowedTracks, window: RootedWindow, rig: StereoRig, gate: FrameGate) -> Information:
        """Gate the newest sightings as the definition does; only the bounds of ``gate`` are used, it counts nothing."""
        counted = tracks.counted
        if counted.left_only.any():
            return tracks_in_view.information(tracks, window, rig, gate)
        arrays = _as_kernel_arrays((counted.uvs_px, counted.seen, tracks.weights, tracks.points))
        poses, root = _as_kernel_arrays((window.poses, window.poses_at)), window.root
        threshold = np.inf if gate.huber is None else float(huber_threshold(3, gate.huber))
        rules = np.array([LEAST_DEPTH_M, float(gate.bound(3)), threshold])
        normals = kernel.normals_of_tracks(arrays, poses, _camera(rig), rules)
        to_points, newest, vector = normals[3], normals[5], normals[7]
        eliminated = times_root(to_points, root)
        by_root = (root, newest @ root[-newest.shape[1] :], eliminated)
        points, weights, in_front, taken, of_poses = kernel.information_with_newest(normals, by_root, rules)
        matrix = without_products(transposed_root_times(root, of_poses), eliminated)
        return Information(points, weights, in_front, matrix, root.T @ vector - eliminated.T @ taken)

    return tracks_in_view.Steps(followed, information)


def exponentials(compilation: Compilation) -> Callable[[Array], Array]:
    """Return the function that maps twists (N, 6) to motions (N, 4, 4): :func:`toolkit.geometry.se3_exp`."""
    kernel = _kernel(compilation, "corrections")
    if kernel is None:
        return se3_exp
    return lambda twists: kernel.exponentials(np.ascontiguousarray(twists))


def images(compilation: Compilation) -> multiview.Images:
    """Return the functions that predict images: :data:`filters.kalman.multiview.NUMPY`."""
    kernel = _kernel(compilation, "corrections")
    if kernel is None:
        return multiview.NUMPY

    def linearised(points: Array, poses: Array, rig: StereoRig) -> StereoPrediction:
        """Predict images and their Jacobians as the definition does."""
        uvs_px, d_pose, d_point, depths_m = kernel.predict_images(*_as_kernel_arrays((points, poses)), _camera(rig))
        seen = depths_m.shape
        return StereoPrediction(uvs_px, d_pose.reshape(*seen, 3, 6), d_point.reshape(*seen, 3, 3), depths_m)

    def plain(points: Array, poses: Array, rig: StereoRig) -> tuple[Array, Array]:
        """Predict images as the definition does."""
        uvs_px, _, _, depths_m = kernel.predict_images(*_as_kernel_arrays((points, poses)), _camera(rig))
        return uvs_px, depths_m

    return multiview.Images(plain, linearised)


def integrator(noise: MotionNoise, gravity_world: Array, compilation: Compilation) -> Integrator:
    """Return an integrator for motion of a noise model under gravity (3,) m/s^2: the motion model, or its kernel."""
    model = motion_model(noise, gravity_world)
    kernel = _kernel(compilation, "preintegration") if isinstance(noise, ImuNoise) else None
    if kernel is None:
        return model
    assert isinstance(noise, ImuNoise)
    densities = noise.accel_noise_density, noise.gyro_noise_density, noise.accel_random_walk, noise.gyro_random_walk
    return _ImuIntegrator(model, kernel, np.square([*densities, INTEGRATION_DENSITY]), np.array(gravity_world))


class _ImuIntegrator(NamedTuple):
    """Integrates samples by the kernel as the model does by GTSAM; variances and gravity are in the kernel's form."""

    model: MotionModel
    kernel: ModuleType
    variances: Array
    gravity_world: Array

    def integrate(self, motion: Motion, bias: Array) -> Increment:
        """Return the samples between two frames, to be integrated about a bias (6,)."""
        assert isinstance(motion, ImuMotion)
        return _ImuIncrement(motion, bias, self)


class _ImuIncrement(NamedTuple):
    """The samples between two frames and a bias; they are integrated when a state is predicted over them."""

    motion: ImuMotion
    bias: Array
    by: _ImuIntegrator

    def predict(self, start: Belief) -> Prediction:
        """Predict a state over the interval."""
        motion, variances = self.motion, self.by.variances
        if motion.noise_scale is not None:
            variances = np.concatenate([np.square(mean_noise_scale(motion)) * variances[:2], variances[2:]])
        samples = np.array(motion.dt_s), np.array(motion.accel_mps2), np.array(motion.gyro_radps)
        state = _pose_of(start), np.array(start.v_world), np.array(start.bias)
        return Prediction(*self.by.kernel.predict(samples, variances, state, self.by.gravity_world))

    def transition_between(self, start: Belief, end: Prediction) -> Array:
        """Return the transition (15, 15) from the mean of ``start`` to that of ``end``."""
        return transition_over(float(self.motion.dt_s.sum()), self.by.gravity_world, start, end)

    def factors(self, k: int) -> Any:
        """Return GTSAM's factors between state k - 1 and state k."""
        return self.by.model.integrate(self.motion, self.bias).factors(k)


def _as_kernel_arrays(arrays: Iterable[Array | BoolArray | IntArray]) -> tuple[Any, ...]:
    """Return arrays in the form kernels take."""
    return tuple(np.ascontiguousarray(array) for array in arrays)


def _pose_of(belief: Belief) -> Array:
    """Return the pose (1, 4, 4) in the form kernels take."""
    return np.array(belief.T_world_imu[None], order="C")


def _intrinsics(rig: StereoRig) -> tuple[Array, Array]:
    return np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m]), np.array(rig.T_imu_cam[None])


@lru_cache(maxsize=4)
def _camera(rig: StereoRig) -> tuple[Array, ...]:
    """Return a rig in the form that the kernels of the windowed filters take."""
    return *_intrinsics(rig), np.array(rig.whitener, order="C")
