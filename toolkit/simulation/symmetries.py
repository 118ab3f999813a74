"""The same recording in other coordinates, and played backwards.

``turned``, ``renamed``, ``delayed`` and ``mirrored`` express the same measurements in another world, with other track
ids, by another clock or in a mirror: answers are the same in those coordinates, to rounding. ``reversed_in_time`` is
another recording with the same scene, camera and errors.
"""

from dataclasses import replace

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray, se3
from toolkit.measurements import Prior, StereoRig, is_left_only
from toolkit.motion_samples import Bridges, ImuSamples, MotionSamples, Pairing, TwistSamples
from toolkit.sequence import Observations, Sequence, Truth

# Reflections of the y-axis of body and world, and of the x-axis of the camera; a rotation vector keeps
# its component along the reflected axis, and the other two change sign.
_Y, _ROTATION = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])
_POSE_Y, _CAMERA_X = np.diag([1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0])
# Of rotation, position, velocity and the biases [accel, gyro], in the body frame.
STATE_MIRROR = np.concatenate([np.diag(axis) for axis in (_ROTATION, _Y, _Y, _Y, _ROTATION)])
STATE_MIRROR.flags.writeable = False
_REVERSED: dict[str, Pairing] = {"start": "end", "end": "start", "mean": "mean"}


def turned(sequence: Sequence, yaw_rad: float, shift_m: Array) -> Sequence:
    """Return a recording in another world frame: rotated about the vertical, and then shifted by (3,) m.

    Truth and prior are expressed in it; the measurements stay.
    """
    sine, cosine = np.sin(yaw_rad), np.cos(yaw_rad)
    T_new_old = se3(np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]), shift_m)
    R_new_old, truth, prior = T_new_old[:3, :3], sequence.truth, sequence.prior
    if truth is not None:
        v_world = None if truth.v_world is None else truth.v_world @ R_new_old.T
        truth = replace(truth, T_world_imu=T_new_old @ truth.T_world_imu, v_world=v_world)
    if prior is not None:
        prior = replace(prior, T_world_imu=T_new_old @ prior.T_world_imu, v_world=R_new_old @ prior.v_world)
    return replace(sequence, truth=truth, prior=prior)


def renamed(sequence: Sequence, ids: IntArray) -> Sequence:
    """Return a recording in which the sightings (N,) have other track ids (N,).

    Which tracks are withheld follows from the ids: rename visible tracks alone, or leave the withheld ones out before.
    """
    seen = sequence.observations
    return replace(sequence, observations=Observations.sorted(seen.frame, ids, seen.uv_px))


def delayed(sequence: Sequence, by_ns: int) -> Sequence:
    """Return a recording with all stamps ``by_ns`` nanoseconds later."""
    motion, truth, bridges = sequence.motion, sequence.truth, sequence.bridges
    if bridges is not None:
        bridges = replace(bridges, begin_t_ns=bridges.begin_t_ns + by_ns, end_t_ns=bridges.end_t_ns + by_ns)
    return replace(
        sequence,
        frames_t_ns=sequence.frames_t_ns + by_ns,
        motion=motion.of(motion.t_ns + by_ns, motion.values),
        truth=None if truth is None else replace(truth, t_ns=truth.t_ns + by_ns),
        bridges=bridges,
    )


def mirrored(sequence: Sequence) -> Sequence:
    """Return a recording as a mirror shows it: left is right, of body, world and images alike.

    The y-axes of body and world are reflected. The two cameras exchange their places, and columns are counted from the
    other side, so that the rig is an ordinary one again. Raises DataError where a sighting has no right image: it would
    be one of the right camera alone.
    """
    seen, rig, prior = sequence.observations, sequence.rig, sequence.prior
    if is_left_only(seen.uv_px).any():
        raise DataError(f"{sequence.name}: sightings by the left camera alone cannot be mirrored; leave them out")
    uv_px = seen.uv_px[:, [1, 0, 2]]
    uv_px[:, :2] = 2.0 * rig.cx_px - uv_px[:, :2]
    return replace(
        sequence,
        rig=_mirrored_rig(rig),
        observations=replace(seen, uv_px=uv_px),
        motion=_mirrored_samples(sequence.motion),
        gravity_world=_Y @ sequence.gravity_world,
        prior=None if prior is None else _mirrored_prior(prior),
        truth=None if sequence.truth is None else _mirrored_truth(sequence.truth),
    )


def mirrored_poses(T_world_imu: Array) -> Array:
    """Return poses (..., 4, 4) as a mirror shows them, and those of a mirrored recording as they are."""
    return np.asarray(_POSE_Y @ T_world_imu @ _POSE_Y)


def _mirrored_rig(rig: StereoRig) -> StereoRig:
    T_left_right = se3(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0]))
    exchange = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(
        rig,
        T_imu_cam=_POSE_Y @ rig.T_imu_cam @ T_left_right @ _CAMERA_X,
        cov_uv_px2=exchange @ rig.cov_uv_px2 @ exchange.T,
    )


def _mirrored_samples(motion: MotionSamples) -> MotionSamples:
    if not motion.values.size:
        return motion
    return motion.of(motion.t_ns, motion.values * np.concatenate([np.diag(_Y), np.diag(_ROTATION)]))


def _mirrored_prior(prior: Prior) -> Prior:
    return replace(
        prior,
        T_world_imu=mirrored_poses(prior.T_world_imu),
        v_world=_Y @ prior.v_world,
        bias=STATE_MIRROR[9:] * prior.bias,
        cov=STATE_MIRROR[:, None] * prior.cov * STATE_MIRROR,
    )


def _mirrored_truth(truth: Truth) -> Truth:
    return replace(
        truth,
        T_world_imu=mirrored_poses(truth.T_world_imu),
        v_world=None if truth.v_world is None else truth.v_world @ _Y,
        bias=None if truth.bias is None else STATE_MIRROR[9:] * truth.bias,
    )


def reversed_in_time(sequence: Sequence) -> Sequence:
    """Return a recording played backwards, without a prior: velocities and turn rates are negated, forces stay.

    An error of the gyro, its bias included, is negated together with its reading. A track that was lost where it was
    seen best begins there.
    """
    first_ns, last_ns = sequence.frames_t_ns[[0, -1]].tolist()
    seen, truth, bridges, both_ns = sequence.observations, sequence.truth, sequence.bridges, first_ns + last_ns
    if truth is not None:
        truth = replace(
            truth,
            t_ns=both_ns - truth.t_ns[::-1],
            T_world_imu=truth.T_world_imu[::-1],
            v_world=None if truth.v_world is None else -truth.v_world[::-1],
            bias=None if truth.bias is None else truth.bias[::-1] * np.repeat([1.0, -1.0], 3),
        )
    if bridges is not None:
        bridges = Bridges(
            both_ns - bridges.end_t_ns[::-1], both_ns - bridges.begin_t_ns[::-1], bridges.noise_scale[::-1]
        )
    return replace(
        sequence,
        frames_t_ns=both_ns - sequence.frames_t_ns[::-1],
        observations=Observations.sorted(sequence.frame_count - 1 - seen.frame, seen.track_id, seen.uv_px),
        motion=_reversed_samples(sequence.motion, both_ns),
        prior=None,
        truth=truth,
        bridges=bridges,
    )


def _reversed_samples(motion: MotionSamples, both_ns: int) -> MotionSamples:
    t_ns, values = both_ns - motion.t_ns[::-1], motion.values[::-1]
    if isinstance(motion, TwistSamples):
        return replace(motion.of(t_ns, -values), pairing=_REVERSED[motion.pairing])
    if isinstance(motion, ImuSamples):
        return motion.of(t_ns, values * np.repeat([1.0, -1.0], 3))
    return motion.of(t_ns, values)
