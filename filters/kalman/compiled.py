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

from filters.kalman import correction, landmark_map, multiview, track_gate, tracks_in_view, triangulation
from filters.kalman.correction import FrameCorrection
from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import JointBelief, times_root, transposed_root_times, without_products
from filters.kalman.landmark_map import LandmarkMap
from filters.kalman.linearisation import Integrator
from filters.kalman.multiview import TrackSightings
from filters.kalman.track_gate import TestedTracks, TrackTest, WindowPoses
from filters.kalman.tracks_in_view import FollowedTracks, Information, RootedWindow
from toolkit.compilation import Compilation
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp
from toolkit.measured_motion import ImuMotion, ImuNoise, Motion, MotionNoise, TwistMotion, TwistNoise
from toolkit.models import left_only
from toolkit.models.gating import (
    FEWEST_SIGHTINGS,
    LEAST_DEPTH_M,
    LEAST_DISPARITY_PX,
    MISMATCHED_TRACK_FACTOR,
    huber_threshold,
)
from toolkit.models.imu import INTEGRATION_DENSITY, mean_noise_scale, transition_over
from toolkit.models.motion import Increment, MotionModel, motion_model, predicted
from toolkit.models.state import Belief, Prediction
from toolkit.models.stereo import StereoPrediction
from toolkit.sequence import StereoRig, is_left_only

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


class DecoupledSteps(NamedTuple):
    """Functions that predict a belief, correct it and N landmarks by sightings (N, 3) px, and start landmarks."""

    predict: Callable[[Belief, Motion], Belief]
    correct: Callable[[Belief, LandmarkMap, Array, StereoRig, FrameGate], FrameCorrection]
    start: Callable[[Array, Array, StereoRig], tuple[Array, Array]]


def decoupled_steps(model: MotionModel, noise: MotionNoise, compilation: Compilation) -> DecoupledSteps:
    """Return the steps of the decoupled filter for a motion model and its noise.

    The definitions are ``motion.predicted``, ``correction.corrected`` and ``landmark_map.started``. Only motion by
    twists has a kernel; other motion is predicted by the model.
    """
    kernel = _kernel(compilation, "decoupled")
    twists = _kernel(compilation, "twists") if isinstance(noise, TwistNoise) and kernel is not None else None
    if kernel is None:
        return DecoupledSteps(_predicted_by(model), correction.corrected, landmark_map.started)

    def corrected(
        belief: Belief, landmarks: LandmarkMap, uvs_px: Array, rig: StereoRig, gate: FrameGate
    ) -> FrameCorrection:
        """Correct the pose by the landmarks, then the landmarks by the pose, as the definition does."""
        missing = is_left_only(uvs_px)
        measured = np.where(np.isnan(uvs_px), 0.0, uvs_px) if missing.any() else uvs_px
        moved_by, step, cov, points, covs, nis, accepted = kernel.correct(
            (landmarks.points, landmarks.covs, measured[:, None], missing),
            (_pose_of(belief), np.array(belief.cov, order="C")),
            _camera_with_left(rig),
            _sighting_rules(gate.probability, gate.huber),
        )
        gate.count(nis, left_only.degrees_of_freedom(uvs_px), accepted)
        moved = belief.displaced(moved_by, step[0])
        belief = Belief(moved.layout, moved.T_world_imu, moved.v_world, moved.bias, cov)
        return FrameCorrection(belief, LandmarkMap(landmarks.track_ids, points, covs))

    def started(uvs_px: Array, T_world_imu: Array, rig: StereoRig) -> tuple[Array, Array]:
        """Return the stereo triangulation of N landmarks and its covariances, as the definition does."""
        points, covs = kernel.start(uvs_px, np.array(T_world_imu[None], order="C"), _camera_with_left(rig))
        return points, covs

    predict = _predicted_by(model) if twists is None else _predicted_along_twists(noise, twists)
    return DecoupledSteps(predict, corrected, started)


def _predicted_by(model: MotionModel) -> Callable[[Belief, Motion], Belief]:
    return lambda belief, motion: predicted(belief, model, motion)


def _predicted_along_twists(noise: MotionNoise, kernel: ModuleType) -> Callable[[Belief, Motion], Belief]:
    """Return the function that predicts pose and gyro bias over twists of a noise model."""
    assert isinstance(noise, TwistNoise)
    densities = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density, noise.gyro_random_walk]) ** 2

    def along_twists(belief: Belief, motion: Motion) -> Belief:
        assert isinstance(motion, TwistMotion)
        scale = _EVEN_NOISE if motion.noise_scale is None else np.array(motion.noise_scale)
        twists = np.array(motion.dt_s), np.array(motion.w_radps), np.array(motion.v_mps), scale
        state = _pose_of(belief), np.array(belief.bias[3:]), np.array(belief.cov, order="C")
        T_world_imu, cov = kernel.predict(twists, densities, state)
        return Belief(belief.layout, T_world_imu[0], belief.v_world, belief.bias, cov)

    return along_twists


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


@lru_cache(maxsize=4)
def _camera_with_left(rig: StereoRig) -> tuple[Array, ...]:
    """Return a rig in the form that the kernels of the decoupled filter take."""
    return *_intrinsics(rig), np.stack([rig.cov_uv_px2, left_only.left_noise_px2(rig)])


@lru_cache(maxsize=4)
def _sighting_rules(probability: float | None, huber: float | None) -> Array:
    """Return bound and Huber threshold (2, 2), in row 0 for sightings in both images, in row 1 for the left alone."""
    thresholds = np.full(2, np.inf) if huber is None else huber_threshold(_DOF, huber)
    return np.column_stack([FrameGate(probability).bound(_DOF), thresholds])
