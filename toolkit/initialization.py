"""The state every estimator starts from, found without truth: from the first stereo frames and the motion samples.

A twist needs none of it: the world is the first IMU frame. So it is where no motion was measured; velocity and turn
rate then come from a short bundle adjustment over the first frames, with the motion model of the smoothers. With raw
IMU samples roll and pitch come from the
specific force, velocity and gyro bias from a short visual-inertial bundle adjustment over the first frames,
with the factors the smoothers use. Heading and position are the gauge and start at zero.
"""

from itertools import pairwise

import gtsam
import numpy as np

from toolkit.errors import DataError
from toolkit.estimate import Estimate
from toolkit.geometry import Array, IntArray, se3, so3_exp, transform
from toolkit.measured_motion import ImuMotion, ImuNoise, Motion, TwistChangeNoise, TwistNoise
from toolkit.models import stereo
from toolkit.models.factors import B, L, StereoFactors, X, joint_cov
from toolkit.models.motion import MotionModel, motion_model
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Packet, Prior, Sequence, StereoFrame, StereoRig

WINDOW_S, FEWEST_FRAMES, MOST_FRAMES, FEWEST_TRACKS = 1.5, 4, 30, 6
# What the gauge is held to (rad, m), and the biases' before any measurement (m/s^2, rad/s).
GAUGE_SIGMA, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA = 1e-4, 0.05, 0.02
# Without enough vision: unknown speed (m/s), and the tilt (rad) an acceleration of 1 m/s^2 feigns.
_BLIND_VELOCITY_SIGMA, _BLIND_TILT_SIGMA = 10.0, 0.1
# What a turn rate that nobody measured may be at first (rad/s).
_TURN_SIGMA = 2.0
_SOURCE = {"imu": "the specific force and stereo of the first", "none": "stereo alone, of the first"}
# The estimators read the window's measurements again: in the start they count for a ninth.
_INFLATION = 9.0
# The start's own, whatever the estimators use: each frame is triangulated by itself, so its landmarks need a depth that
# is known to half itself at a pixel of noise; and Huber's threshold is the median norm of a sound whitened residual.
_LEAST_DISPARITY_PX = 2.0
_HUBER = 1.5


def start_from_measurements(sequence: Sequence) -> Prior:
    """Return the state at the first frame from about the first second and a half of the recording.

    A recording that brings its own prior, as a simulated one does, is started from that.
    """
    if sequence.prior is not None:
        return sequence.prior
    if isinstance(sequence.noise, TwistNoise):
        return _own_frame()
    packets = _first_packets(sequence)
    motions = [p.motion for p in packets if p.motion is not None]
    measured = [motion for motion in motions if isinstance(motion, ImuMotion)]
    attitudes = _attitudes(measured) if measured else [np.eye(3)] * len(packets)
    tracks = _tracks_worth_using([p.frame for p in packets])
    if len(packets) < FEWEST_FRAMES or tracks.size < FEWEST_TRACKS:
        return _blind(attitudes[0], "there are too few tracks in the first frames", sequence)
    return _adjusted([_only(p.frame, tracks) for p in packets], motions, attitudes, sequence)


def start_from_truth(sequence: Sequence) -> Prior:
    """Return the truth at the first frame as the state to start from, known to 0.01 rad, 0.01 m and 0.05 m/s.

    Raises DataError where there is no truth at the first frame.
    """
    truth, first_ns = sequence.truth, sequence.frames_t_ns[0]
    near = np.empty(0) if truth is None else np.flatnonzero(np.abs(truth.t_ns - first_ns) < NS_PER_S // 1000)
    if truth is None or near.size == 0:
        raise DataError(f"{sequence.name}: no truth at the first frame to start from; start from the measurements")
    row = int(near[0])
    if truth.v_world is not None:
        v_world = truth.v_world[row]
    else:
        neighbours = slice(max(row - 1, 0), row + 2)
        t_s, positions = truth.t_ns[neighbours] / NS_PER_S, truth.T_world_imu[neighbours, :3, 3]
        v_world = (positions[-1] - positions[0]) / (t_s[-1] - t_s[0])
    cov = np.diag(np.repeat([0.01, 0.01, 0.05, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3) ** 2)
    return Prior(truth.T_world_imu[row], v_world, np.zeros(6), cov, "the truth at the first frame, as asked for")


def _own_frame() -> Prior:
    cov = np.diag(np.repeat([GAUGE_SIGMA, GAUGE_SIGMA, 1.0, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3) ** 2)
    return Prior(np.eye(4), np.zeros(3), np.zeros(6), cov, "the first IMU frame as the world, no gyro bias")


def _first_packets(sequence: Sequence) -> list[Packet]:
    packets: list[Packet] = []
    for packet in sequence.packets():
        elapsed_s = (packet.frame.t_ns - sequence.frames_t_ns[0]) / NS_PER_S
        if len(packets) >= FEWEST_FRAMES and (elapsed_s > WINDOW_S or len(packets) >= MOST_FRAMES):
            break
        packets.append(packet)
    return packets


def _attitudes(motions: list[ImuMotion]) -> list[Array]:
    """Return the rotations (3, 3) world <- IMU at each frame: levelled by the specific force, carried by the gyro."""
    turn, turns = np.eye(3), [np.eye(3)]
    force, total_s = np.zeros(3), 0.0
    for motion in motions:
        for dt_s, accel, gyro in zip(motion.dt_s, motion.accel_mps2, motion.gyro_radps, strict=True):
            turn = turn @ so3_exp(0.5 * dt_s * gyro)
            force, total_s = force + dt_s * (turn @ accel), total_s + dt_s
            turn = turn @ so3_exp(0.5 * dt_s * gyro)
        turns.append(turn)
    up = force / np.linalg.norm(force)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    half_turn = np.array([np.pi, 0.0, 0.0]) if up[2] < 0.0 else np.zeros(3)
    level = so3_exp(axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else half_turn)
    return [level @ turn for turn in turns]


def _blind(attitude: Array, why: str, sequence: Sequence) -> Prior:
    """Return the start from the specific force alone, if there is any, and in its source why vision was not used."""
    if isinstance(sequence.noise, TwistChangeNoise):
        sigmas = [GAUGE_SIGMA, GAUGE_SIGMA, _BLIND_VELOCITY_SIGMA, ACCEL_BIAS_SIGMA, _TURN_SIGMA]
        source = f"the first frame as the world; velocity and turn rate unknown and taken for zero, for {why}"
        return Prior(np.eye(4), np.zeros(3), np.zeros(6), np.diag(np.repeat(sigmas, 3) ** 2), source)
    tilt_cov = np.diag([_BLIND_TILT_SIGMA**2, _BLIND_TILT_SIGMA**2, GAUGE_SIGMA**2])
    cov = np.diag(np.repeat([0.0, GAUGE_SIGMA, _BLIND_VELOCITY_SIGMA, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3) ** 2)
    cov[:3, :3] = attitude.T @ tilt_cov @ attitude
    cov = 0.5 * (cov + cov.T)
    source = f"the specific force; velocity unknown and taken for zero, for {why}"
    return Prior(se3(attitude, np.zeros(3)), np.zeros(3), np.zeros(6), cov, source)


def _tracks_worth_using(frames: list[StereoFrame]) -> IntArray:
    """Return the ids of the tracks with two good sightings or more."""
    good = [f.track_ids[stereo.disparity_px(f.uvs_px) > _LEAST_DISPARITY_PX] for f in frames]
    ids, counts = np.unique(np.concatenate(good), return_counts=True)
    return ids[counts >= 2]


def _only(frame: StereoFrame, tracks: IntArray) -> StereoFrame:
    kept = np.isin(frame.track_ids, tracks) & (stereo.disparity_px(frame.uvs_px) > _LEAST_DISPARITY_PX)
    return frame.select(kept)


def _positions(frames: list[StereoFrame], attitudes: list[Array], rig: StereoRig) -> Array:
    """Return rough positions (K, 3) m: the median motion of the points two frames share, turned by the gyro."""
    positions = [np.zeros(3)]
    for (before, attitude_before), (after, attitude) in pairwise(zip(frames, attitudes, strict=True)):
        _, rows_before, rows_after = np.intersect1d(before.track_ids, after.track_ids, return_indices=True)
        if rows_before.size == 0:
            positions.append(positions[-1])
            continue
        points_before = transform(rig.T_imu_cam, stereo.triangulate(before.uvs_px[rows_before], rig))
        points_after = transform(rig.T_imu_cam, stereo.triangulate(after.uvs_px[rows_after], rig))
        moved = points_before @ attitude_before.T - points_after @ attitude.T
        positions.append(positions[-1] + np.median(moved, axis=0))
    return np.array(positions)


def _adjusted(frames: list[StereoFrame], motions: list[Motion], attitudes: list[Array], sequence: Sequence) -> Prior:
    """Adjust poses, velocities, biases and landmarks of the first frames and return the state at the first."""
    model = motion_model(sequence.noise, sequence.gravity_world)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    positions = _positions(frames, attitudes, sequence.rig)
    stamps_s = np.array([f.t_ns - frames[0].t_ns for f in frames]) / NS_PER_S
    velocities = np.gradient(positions, stamps_s, axis=0)
    maker = StereoFactors(sequence.rig, gtsam.noiseModel.mEstimator.Huber.Create(_HUBER))
    if isinstance(sequence.noise, ImuNoise):
        _hold_gauge(graph, attitudes[0])
    else:
        _hold_first_frame(graph)
    for k, frame in enumerate(frames):
        T_world_imu = se3(attitudes[k], positions[k])
        model.insert(values, Estimate(frame.t_ns, T_world_imu, v_world=velocities[k], bias=np.zeros(6)), k)
        points = stereo.triangulate_world(frame.uvs_px, T_world_imu, sequence.rig)
        for track_id, point in zip(frame.track_ids.tolist(), points, strict=True):
            if not values.exists(L(track_id)):
                values.insert(L(track_id), point)
        for factor in maker.of(frame, k):
            graph.add(factor)
        if k:
            graph.push_back(model.integrate(motions[k - 1], np.zeros(6)).factors(k))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    try:
        solved = optimizer.optimize()
        if np.isfinite(optimizer.error()):
            return _first_state(graph, solved, model, f"{_SOURCE[sequence.motion_kind]} {len(frames)} frames")
    except RuntimeError as refusal:
        if "Indeterminate" not in str(refusal):
            raise
    return _blind(attitudes[0], "the adjustment of the first frames has no sound solution", sequence)


def _hold_gauge(graph: gtsam.NonlinearFactorGraph, attitude: Array) -> None:
    """Pin heading and position, leave roll and pitch free, and add the priors of the biases."""
    tilt_free = attitude.T @ np.diag([1.0, 1.0, GAUGE_SIGMA**2]) @ attitude
    cov = np.block([[tilt_free, np.zeros((3, 3))], [np.zeros((3, 3)), GAUGE_SIGMA**2 * np.eye(3)]])
    pose = gtsam.Pose3(se3(attitude, np.zeros(3)))
    graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
    sigmas = np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3)
    graph.add(
        gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(sigmas))
    )


def _hold_first_frame(graph: gtsam.NonlinearFactorGraph) -> None:
    """Pin the whole pose, which is the world, and say how large a turn rate may be."""
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)))
    graph.add(gtsam.PriorFactorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, _TURN_SIGMA)))


def _first_state(graph: gtsam.NonlinearFactorGraph, solved: gtsam.Values, model: MotionModel, source: str) -> Prior:
    first = model.read(solved, 0, 0)
    assert first.v_world is not None and first.bias is not None
    cov = joint_cov(gtsam.Marginals(graph, solved), model.keys(0))
    cov = _INFLATION * model.estimate_cov(cov, first.T_world_imu[:3, :3])
    if model.layout.accel_bias is None:
        cov = _with_accel_bias(cov)
    return Prior(first.T_world_imu, first.v_world, first.bias, cov, source)


def _with_accel_bias(cov: Array) -> Array:
    """Return the covariance (15, 15) of a prior from that of pose, velocity and turn rate (12, 12)."""
    whole = np.diag(np.full(15, ACCEL_BIAS_SIGMA**2))
    kept = np.r_[0:9, 12:15]
    whole[np.ix_(kept, kept)] = cov
    return whole
