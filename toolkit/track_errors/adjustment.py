"""Poses of the camera that fit all tracks under a track noise: a bundle adjustment over the recording, without gtsam.

Landmarks are eliminated track by track, which couples only the poses that a track spans, so that the normal equations
of the poses are banded (Triggs et al., "Bundle adjustment", 2000, section 8.2); a track's weight is that of a Student-t
(Lange, Little & Taylor 1989). Where tracks do not determine a motion, a weak prior at its initial value holds it.
"""

from dataclasses import dataclass, replace

import numpy as np

from toolkit.audit.parts.intervals import interval_means
from toolkit.geometry import Array, IntArray, se3_adjoint, se3_exp, se3_inverse, se3_log
from toolkit.measured_motion import ImuSamples, TwistSamples
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, StereoRig
from toolkit.track_errors.tracklets import (
    MOST_SIGHTINGS,
    Tailed,
    Tracklets,
    linearised,
    middle_of_pair,
    whitened,
    whitening,
)

# Standard deviations of the prior of an interval's motion, rad/s and m/s: far above its uncertainty by tracks.
_PRIOR_SIGMA = np.repeat([0.1, 2.0], 3)
# Tracks whose (3 n, 6 n) Jacobians are in memory at a time.
_AT_ONCE = 400
_PROBES = 8
# Information on the first pose, which is held fixed.
_FIXED = 1e12


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses (K, 4, 4) of the camera in the middle of the pair, and the tracks with their landmarks.

    ``freedom`` is the share of the tracks' degrees of freedom that remains after the poses are fitted: residuals about
    fitted poses are smaller than errors by its root.
    """

    T_world_middle: Array
    tracks: tuple[Tracklets, ...]
    freedom: float


def started(sequence: Sequence, tracks: tuple[Tracklets, ...]) -> Adjusted:
    """Return the poses chained from two-view motions of the visible tracks, from motion samples where they fail."""
    visible = replace(sequence, observations=sequence.visible)
    camera = camera_motion(visible)
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    twist = np.where(
        camera.known[:, None], np.concatenate([camera.w_radps, camera.v_mps], axis=1), _measured(sequence, camera)
    )
    T_cam_middle = middle_of_pair(sequence.rig)
    steps = se3_inverse(T_cam_middle) @ se3_exp(dt_s * twist) @ T_cam_middle
    poses = np.empty((sequence.frame_count, 4, 4))
    poses[0] = np.eye(4)
    for k, step in enumerate(steps):
        poses[k + 1] = poses[k] @ step
    return Adjusted(poses, tracks, 1.0)


def _measured(sequence: Sequence, camera: CameraMotion) -> Array:
    """Return the camera's twist (K - 1, 6); where its own motion failed, a measured or a neighbouring one."""
    known = np.flatnonzero(camera.known)
    seen = np.concatenate([camera.w_radps, camera.v_mps], axis=1)
    twist = np.zeros_like(seen)
    if known.size:
        everywhere = np.arange(len(seen))
        twist = np.stack([np.interp(everywhere, known, column) for column in seen[known].T], axis=1)
    motion = sequence.motion
    if not isinstance(motion, TwistSamples | ImuSamples):
        return twist
    mean = interval_means(motion.t_ns, motion.values, sequence.frames_t_ns)
    R_imu_cam, arm = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    twist[:, :3] = mean[:, 3:] @ R_imu_cam
    if isinstance(motion, TwistSamples):
        twist[:, 3:] = (mean[:, :3] + np.cross(mean[:, 3:], arm)) @ R_imu_cam
    return twist


def adjusted(start: Adjusted, model: Tailed, sequence: Sequence, iterations: int) -> Adjusted:
    """Return the poses and landmarks after ``iterations`` Gauss-Newton steps from the start."""
    from scipy.linalg import cho_solve_banded, cholesky_banded  # imported here because most processes do not need it

    poses, tracks, freedom = start.T_world_middle, start.tracks, start.freedom
    tie = _MotionPrior(
        se3_inverse(poses[:-1]) @ poses[1:], _PRIOR_SIGMA * np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    )
    for _ in range(iterations):
        system = _normal_equations(tracks, poses, sequence.rig, model)
        rows, error = tie.equations(poses)
        _add(system, np.arange(len(rows)), rows, error)
        factor = (cholesky_banded(_banded(system.matrix), lower=True), True)
        step = cho_solve_banded(factor, system.gradient.ravel()).reshape(-1, 6)
        poses = poses @ se3_exp(step)
        tracks = tuple(
            group.moved(alone - (by_pose @ step[group.frames].reshape(len(alone), -1, 1))[..., 0])
            for group, (alone, by_pose) in zip(tracks, system.landmarks, strict=True)
        )
        equations = sum(group.equations * len(group.first_frame) for group in tracks)
        freedom = 1.0 - _used_up(factor, rows) / equations
    return Adjusted(poses, tracks, freedom)


def _used_up(factor: tuple[Array, bool], tie: Array) -> float:
    """Return how many unknowns the tracks determine: all but tr(R A^-1 R^T), by random signs (Hutchinson 1990).

    ``tie`` (K - 1, 6, 12) are the rows R of the ties, A is the whole normal matrix.
    """
    from scipy.linalg import cho_solve_banded

    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(*tie.shape[:2], _PROBES))
    by_pose = np.swapaxes(tie, 1, 2) @ signs
    right = np.zeros((len(tie) + 1, 6, _PROBES))
    right[:-1] += by_pose[:, :6]
    right[1:] += by_pose[:, 6:]
    columns = right.reshape(-1, _PROBES)
    return 6.0 * len(tie) - float((columns * cho_solve_banded(factor, columns)).sum()) / _PROBES


@dataclass(frozen=True, eq=False)
class _MotionPrior:
    """A prior on the motions of the intervals: means (K - 1, 4, 4) and standard deviations (K - 1, 6)."""

    motion: Array
    sigma: Array

    def equations(self, poses: Array) -> tuple[Array, Array]:
        """Return whitened Jacobians (K - 1, 6, 12) to each interval's two poses, and the errors (K - 1, 6)."""
        moved = se3_inverse(poses[:-1]) @ poses[1:]
        error = se3_log(se3_inverse(self.motion) @ moved)
        by_start = -se3_adjoint(se3_inverse(moved))
        rows = np.concatenate([by_start, np.broadcast_to(np.eye(6), by_start.shape)], axis=2)
        return rows / self.sigma[..., None], -error / self.sigma


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of the poses, and the elimination of the landmarks.

    ``matrix`` (K, w, w): block k is the sum over equations whose first pose is k, on the w / 6 poses from k on;
    ``gradient`` (K, 6). ``landmarks`` has a pair for each group of tracks: the landmark step (B, 3) px with the poses
    fixed, and its derivative (B, 3, 6 n), negated, by steps of the poses.
    """

    matrix: Array
    gradient: Array
    landmarks: list[tuple[Array, Array]]


def _normal_equations(tracks: tuple[Tracklets, ...], poses: Array, rig: StereoRig, model: Tailed) -> _System:
    width = 6 * MOST_SIGHTINGS
    system = _System(np.zeros((len(poses), width, width)), np.zeros((len(poses), 6)), [])
    system.matrix[0, :6, :6] += _FIXED * np.eye(6)
    for group in tracks:
        per_channel, steps = whitening(model.noise, group.sightings), []
        for begin in range(0, len(group.first_frame), _AT_ONCE):
            some = group.select(slice(begin, begin + _AT_ONCE))
            here = linearised(some, poses, rig)
            rows = np.concatenate(
                [_by_poses(per_channel, here.d_pose), whitened(per_channel, here.residual_px)[..., None]], axis=2
            )
            basis, upper = np.linalg.qr(whitened(per_channel, here.d_landmark))
            taken = np.swapaxes(basis, 1, 2) @ rows
            rows -= basis @ taken
            rows *= np.sqrt(model.weights((rows[..., -1] ** 2).sum(axis=1), group.equations))[:, None, None]
            _add(system, some.first_frame, rows[..., :-1], rows[..., -1])
            step = np.linalg.solve(upper, taken)
            # A landmark is parametrised in its first frame and moves with that pose; the equations take it as fixed in
            # the world.
            step[..., :6] -= here.d_pose[:, 0]
            steps.append(step)
        all_steps = np.concatenate(steps)
        system.landmarks.append((all_steps[..., -1], all_steps[..., :-1]))
    return system


def _by_poses(per_channel: Array, d_pose: Array) -> Array:
    """Return whitened rows (B, 3 n, 6 n): a row of a channel depends on the poses of all sightings up to its own."""
    count, n = d_pose.shape[:2]
    rows: Array = np.einsum("cij,bjcp->bicjp", per_channel, d_pose)
    return rows.reshape(count, 3 * n, 6 * n)


def _add(system: _System, first_frame: IntArray, rows: Array, values: Array) -> None:
    """Add equations, rows (B, m, 6 n) and values (B, m), on the poses from the first frames (B,), increasing, on."""
    width = rows.shape[2]
    frames, begin = np.unique(first_frame, return_index=True)
    for frame, first, last in zip(frames.tolist(), begin, np.append(begin[1:], len(rows)), strict=True):
        same = rows[first:last].reshape(-1, width)
        system.matrix[frame, :width, :width] += same.T @ same
        gradient = same.T @ values[first:last].reshape(-1)
        system.gradient[frame : frame + width // 6] += gradient.reshape(-1, 6)


def _banded(matrix: Array) -> Array:
    """Return the sum of overlapping blocks (K, w, w), each 6 further on, in the lower banded form (w, 6 K)."""
    count, width = matrix.shape[:2]
    band = np.zeros((width, 6 * count + width))
    for pose in range(width // 6):
        for column in range(6 * pose, 6 * pose + 6):
            # Column by column of the blocks, from the diagonal down.
            band[: width - column, column : column + 6 * count : 6] += matrix[:, column:, column].T
    return band[:, : 6 * count]
