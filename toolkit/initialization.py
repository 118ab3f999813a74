"""The state every estimator starts from, found without truth: from the first stereo frames and the motion samples.

With measured twists nothing has to be found: the world is the first IMU frame. It is also the first IMU frame where no
motion was measured; velocity and turn rate then come from a short bundle adjustment over the first frames, with the
motion model of the smoothers. With raw IMU samples roll, pitch, velocity and biases come from such an adjustment,
visual-inertial; it needs neither a standstill nor slow motion. Heading and position are the gauge and start at zero.

The first guess of the adjustment is linear: the rotations of the camera by its tracks and the gyro's differ by the
gyro's bias, and with attitudes corrected for it the motion is linear in the velocity and in the gravity in the first
frame. Source: Qin & Shen, "Robust initialization of monocular visual-inertial estimation on aerial robots" (2017),
section V; with stereo the scale is known.
"""

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import gtsam
import numpy as np

from toolkit.errors import DataError, EstimatorError
from toolkit.estimate import Estimate
from toolkit.geometry import Array, BoolArray, IntArray, se3, so3_exp, so3_log
from toolkit.measurements import NS_PER_S, ImuMotion, ImuNoise, Motion, Packet, Prior, StereoFrame, TwistNoise
from toolkit.models import stereo
from toolkit.models.camera_motion import camera_motion
from toolkit.models.factors import B, X
from toolkit.models.gating import FEWEST_SIGHTINGS, MISMATCHED_TRACK_FACTOR, MOST_MISMATCHED, chi2_bound, huber_weights
from toolkit.models.imu import Preintegration, preintegrate, preintegration_params
from toolkit.models.motion import motion_model
from toolkit.models.stereo_adjustment import Ending, RobustCamera, StereoWindow, Vision, solve_window
from toolkit.sequence import Sequence

WINDOW_S, FEWEST_FRAMES, MOST_FRAMES, FEWEST_TRACKS = 1.5, 4, 30, 6
# Without enough vision: sigma of the unknown speed (m/s), and of the tilt (rad), by an acceleration of 1 m/s^2.
_BLIND_VELOCITY_SIGMA, _BLIND_TILT_SIGMA = 10.0, 0.1
_SOURCE = {"imu": "the specific force and stereo of the first", "none": "stereo alone, of the first"}
# The start's own, whatever the estimators use: each frame is triangulated by itself, so its landmarks need a depth that
# is known to half itself at a pixel of noise.
_LEAST_DISPARITY_PX = 2.0
_PRIOR_SIZE = 15
# Standard deviations: of the pose that fixes the gauge (rad, m), and of biases before any measurement (m/s^2, rad/s).
GAUGE_SIGMA, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA = 1e-4, 0.05, 0.02
# Standard deviation of a turn rate that is not measured (rad/s).
TURN_SIGMA = 2.0
# The estimators read the window's measurements again, so that in the start they have a ninth of their weight.
INFLATION = 9.0
# The start's own, whatever the estimators use: Huber's threshold is the median norm of a sound whitened residual.
_HUBER = 1.5
_PROBABILITY = 0.95
# Rounds in which tracks that do not fit are left out.
_ROUNDS = 4
# Tracks that scatter by more than this many of their stated sigmas are not explained by these motions at all.
_MOST_SIGMAS = 5.0
_ENDING = Ending(step_sigmas=1e-2, relative_decrease=1e-9, iterations=50)
# Iterations for the gyro's bias: the second corrects for the linearisation of the first.
_BIAS_STEPS = 2
_REWEIGHTINGS = 5
# Median norm of a normal vector of three unit variances.
_MEDIAN_NORM = 1.54
# Velocity and gravity are six unknowns, and their scatter needs some intervals more than the two they take.
_FEWEST_INTERVALS = 6
# The direction of gravity is known where this many of its sigmas are within this share of its length. If its length is
# then wrong by more than both, vision and accelerometer contradict each other.
_GRAVITY_SHARE, _GRAVITY_SIGMAS = 0.15, 4.0


@dataclass(frozen=True, eq=False)
class FirstGuess:
    """Rough states of K frames: poses (K, 4, 4), velocities (K, 3) m/s in the world, and the biases (6,).

    ``contradiction`` says why vision and the motion samples cannot be of one motion, if so.
    """

    T_world_imu: Array
    v_world: Array
    bias: Array
    contradiction: str | None = None


class NoSoundStartError(Exception):
    """The first frames do not tell the state; the message says why, as the end of a sentence."""


def start_from_measurements(sequence: Sequence) -> Prior:
    """Return the state at the first frame from about the first second and a half of the recording.

    A recording that brings its own prior, as a simulated one does, is started from that. Where the first frames do not
    tell the velocity, it is unknown, and ``source`` says for what reason.
    """
    if sequence.prior is not None:
        return sequence.prior
    if isinstance(sequence.noise, TwistNoise):
        return _own_frame()
    packets = _first_packets(sequence)
    try:
        first, cov = _found(packets, sequence)
    except NoSoundStartError as reason:
        return _blind(packets, str(reason), sequence)
    assert first.v_world is not None
    assert first.bias is not None
    whole = cov if len(cov) == _PRIOR_SIZE else _with_accel_bias(cov)
    source = f"{_SOURCE[sequence.motion_kind]} {len(packets)} frames"
    return Prior(first.T_world_imu, first.v_world, first.bias, whole, source)


def _found(packets: list[Packet], sequence: Sequence) -> tuple[Estimate, Array]:
    """Adjust the first frames, each unknown guessed linearly; raises NoSoundStartError where they do not tell."""
    tracks = _tracks_worth_using([packet.frame for packet in packets])
    if len(packets) < FEWEST_FRAMES or tracks.size < FEWEST_TRACKS:
        raise NoSoundStartError("there are too few tracks in the first frames")
    motions = [packet.motion for packet in packets if packet.motion is not None]
    measured = [motion for motion in motions if isinstance(motion, ImuMotion)]
    visible = sequence.visible.select(sequence.visible.frame < len(packets))
    seen = replace(sequence.truncated(len(packets)), observations=visible)
    guess = guess_with_imu(seen, measured) if measured else guess_from_vision(seen)
    if guess.contradiction is not None:
        raise NoSoundStartError(guess.contradiction)
    return _adjusted([_with_tracks_alone(packet.frame, tracks) for packet in packets], motions, guess, sequence)


def _adjusted(
    frames: list[StereoFrame], motions: list[Motion], guess: FirstGuess, sequence: Sequence
) -> tuple[Estimate, Array]:
    """Adjust the first frames from a guess; return the first state and its covariance as an Estimate has it.

    The motion model and the tracks' shared factors give poses, velocities and biases. Tracks that do not fit are left
    out; the covariance is that of the window of the others, scaled by how much more than stated these scatter.

    Raises NoSoundStartError where the window is indeterminate, or most tracks do not fit the solution.
    """
    model, camera = motion_model(sequence.noise, sequence.gravity_world), RobustCamera(sequence.rig, _HUBER)
    factors = [model.integrate(motion, guess.bias).factors(k) for k, motion in enumerate(motions, start=1)]
    window = StereoWindow.empty()
    for k, (frame, own) in enumerate(zip(frames, [_held(sequence, guess), *factors], strict=True)):
        estimate = Estimate(frame.t_ns, guess.T_world_imu[k], v_world=guess.v_world[k], bias=guess.bias)
        window = window.extended(model, estimate, own, frame, k, sequence.rig)
    all_tracks = window.track_ids.size
    for _ in range(_ROUNDS):
        try:
            solved = solve_window(window, camera, _ENDING)
            cov = solved.cov(0)
        except (EstimatorError, np.linalg.LinAlgError) as refusal:
            raise NoSoundStartError("the adjustment of the first frames has no sound solution") from refusal
        scale2, mismatched = _fit(solved.window, camera)
        if scale2 > _MOST_SIGMAS**2:
            raise NoSoundStartError(f"the tracks scatter by {np.sqrt(scale2):.0f} of their sigmas about any motion")
        window = solved.window.with_sightings(~mismatched[solved.window.sightings.point])
        if window.track_ids.size < (1.0 - MOST_MISMATCHED) * all_tracks:
            raise NoSoundStartError("most tracks of the first frames do not fit the motion of the others")
        if not mismatched.any():
            break
    first = model.read(solved.window.values, 0, frames[0].t_ns)
    return first, max(scale2, 1.0) * INFLATION * model.estimate_cov(cov, first.T_world_imu[:3, :3])


def _fit(window: StereoWindow, camera: RobustCamera) -> tuple[float, BoolArray]:
    """Return the median ratio of the tracks' squared residuals to the stated noise, and which tracks (M,) do not fit.

    A track of n sightings has 3 n - 3 degrees of freedom, its landmark taken out.
    """
    seen = window.sightings
    squares = np.square(Vision.at(window.poses, window.points, seen, camera).whitened).sum(axis=1)
    sightings, chi2 = np.bincount(seen.point), np.bincount(seen.point, weights=squares)
    decided = sightings >= FEWEST_SIGHTINGS
    freedom = 3 * (np.maximum(sightings, FEWEST_SIGHTINGS) - 1)
    scale2 = float(np.median((chi2 / freedom)[decided]))
    bound = MISMATCHED_TRACK_FACTOR * chi2_bound(freedom, _PROBABILITY) * max(scale2, 1.0)
    return scale2, decided & (chi2 > bound)


def _held(sequence: Sequence, guess: FirstGuess) -> gtsam.NonlinearFactorGraph:
    """Return the priors of the first state: what fixes the gauge, and how large biases or a turn rate may be.

    With an IMU heading and position are pinned, roll and pitch are free; else the whole pose, which is the world.
    """
    graph = gtsam.NonlinearFactorGraph()
    if isinstance(sequence.noise, ImuNoise):
        attitude, cov = guess.T_world_imu[0, :3, :3], GAUGE_SIGMA**2 * np.eye(6)
        cov[:3, :3] = attitude.T @ np.diag([1.0, 1.0, GAUGE_SIGMA**2]) @ attitude
        pose = gtsam.Pose3(gtsam.Rot3(attitude), np.zeros(3))
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3))
        graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), sigmas))
    else:
        graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)))
        graph.add(gtsam.PriorFactorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, TURN_SIGMA)))
    return graph


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
    return Prior(truth.T_world_imu[row], v_world, np.zeros(6), cov, "the truth at the first frame, as requested")


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


def _blind(packets: list[Packet], why: str, sequence: Sequence) -> Prior:
    """Return the start levelled by the mean specific force, if there is any; its source says why without vision."""
    if not isinstance(sequence.noise, ImuNoise):
        sigmas = [GAUGE_SIGMA, GAUGE_SIGMA, _BLIND_VELOCITY_SIGMA, ACCEL_BIAS_SIGMA, TURN_SIGMA]
        source = f"the first frame as the world; velocity and turn rate unknown and assumed to be zero, because {why}"
        return Prior(np.eye(4), np.zeros(3), np.zeros(6), np.diag(np.repeat(sigmas, 3) ** 2), source)
    params = preintegration_params(sequence.noise, sequence.gravity_world)
    measured = [packet.motion for packet in packets if isinstance(packet.motion, ImuMotion)]
    path = _Path.of([preintegrate(motion, np.zeros(6), params) for motion in measured])
    attitude = levelling(path.gained_mps[-1])
    tilt_cov = np.diag([_BLIND_TILT_SIGMA**2, _BLIND_TILT_SIGMA**2, GAUGE_SIGMA**2])
    cov = np.diag(np.repeat([0.0, GAUGE_SIGMA, _BLIND_VELOCITY_SIGMA, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3) ** 2)
    cov[:3, :3] = attitude.T @ tilt_cov @ attitude
    cov = 0.5 * (cov + cov.T)
    source = f"the specific force; velocity unknown and assumed to be zero, because {why}"
    return Prior(se3(attitude, np.zeros(3)), np.zeros(3), np.zeros(6), cov, source)


def _tracks_worth_using(frames: list[StereoFrame]) -> IntArray:
    good = [f.track_ids[stereo.disparity_px(f.uvs_px) > _LEAST_DISPARITY_PX] for f in frames]
    ids, counts = np.unique(np.concatenate(good), return_counts=True)
    return ids[counts >= 2]


def _with_tracks_alone(frame: StereoFrame, tracks: IntArray) -> StereoFrame:
    kept = np.isin(frame.track_ids, tracks) & (stereo.disparity_px(frame.uvs_px) > _LEAST_DISPARITY_PX)
    return frame.select(kept)


def _with_accel_bias(cov: Array) -> Array:
    """Return the covariance (15, 15) of a prior from that of pose, velocity and turn rate (12, 12)."""
    whole = np.diag(np.full(_PRIOR_SIZE, ACCEL_BIAS_SIGMA**2))
    kept = np.r_[0:9, 12:15]
    whole[np.ix_(kept, kept)] = cov
    return whole


class _SeenMotion(NamedTuple):
    """The IMU's motion T_before_after (N, 4, 4) over N intervals from the tracks alone, and where it is known (N,)."""

    T_before_after: Array
    known: BoolArray


def guess_from_vision(sequence: Sequence) -> FirstGuess:
    poses = np.array(list(accumulate(_vision_motion(sequence).T_before_after, np.matmul, initial=np.eye(4))))
    t_s = sequence.frames_s
    return FirstGuess(poses, np.gradient(poses[:, :3, 3], t_s, axis=0), np.zeros(6))


def guess_with_imu(sequence: Sequence, motions: list[ImuMotion]) -> FirstGuess:
    """Return the states that the tracks and the IMU's samples between frames show together; the world's z is up.

    Which way is up is the direction of gravity where vision determines it, else of the mean specific force.
    """
    assert isinstance(sequence.noise, ImuNoise)
    seen, params = _vision_motion(sequence), preintegration_params(sequence.noise, sequence.gravity_world)
    bias = np.zeros(6)
    for _ in range(_BIAS_STEPS):
        bias[3:] += _gyro_bias_residual([preintegrate(motion, bias, params) for motion in motions], seen)
    path = _Path.of([preintegrate(motion, bias, params) for motion in motions])
    fallen = float(np.linalg.norm(sequence.gravity_world))
    gravity, contradiction = _gravity(path, seen, fallen)
    v_first = path.velocity_that_fits(seen, gravity)
    level = se3(levelling(-gravity), np.zeros(3))
    poses = level @ se3(path.attitudes, path.positions(v_first, gravity))
    return FirstGuess(poses, path.velocities(v_first, gravity) @ level[:3, :3].T, bias, contradiction)


def _vision_motion(sequence: Sequence) -> _SeenMotion:
    moved = camera_motion(sequence)
    dt_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    return _SeenMotion(moved.steps_of_imu(dt_s, sequence.rig.T_imu_cam), moved.known)


def _gyro_bias_residual(pieces: list[Preintegration], seen: _SeenMotion) -> Array:
    """Return the rate (3,) rad/s by which the gyro turns faster than the tracks show, over all known intervals.

    A bias b over dt turns by exp(-b dt) on the right, to first order.
    """
    if not seen.known.any():
        return np.zeros(3)
    turned = np.array([piece.deltaRij().matrix() for piece in pieces])
    dt_s = np.array([piece.deltaTij() for piece in pieces])
    off = so3_log(np.swapaxes(turned, 1, 2) @ seen.T_before_after[:, :3, :3])
    rate, _ = _robust(-(dt_s[:, None, None] * np.eye(3))[seen.known], off[seen.known])
    return rate


@dataclass(frozen=True, eq=False)
class _Path:
    """The motion over N intervals by the IMU alone, in the axes of the first frame.

    ``t_s`` (N + 1,), ``attitudes`` (N + 1, 3, 3), and ``gained_mps``, ``gained_m`` (N + 1, 3): velocity and position
    that the specific force has given since the first frame, from rest and without gravity.
    """

    t_s: Array
    attitudes: Array
    gained_mps: Array
    gained_m: Array

    @classmethod
    def of(cls, pieces: list[Preintegration]) -> "_Path":
        t_s, turn, speed, place = [0.0], [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
        for piece in pieces:
            dt_s = piece.deltaTij()
            place.append(place[-1] + dt_s * speed[-1] + turn[-1] @ piece.deltaPij())
            speed.append(speed[-1] + turn[-1] @ piece.deltaVij())
            turn.append(turn[-1] @ piece.deltaRij().matrix())
            t_s.append(t_s[-1] + dt_s)
        return cls(np.array(t_s), np.array(turn), np.array(speed), np.array(place))

    def positions(self, v_first: Array, gravity: Array) -> Array:
        return np.asarray(self.gained_m + self.t_s[:, None] * v_first + 0.5 * self.t_s[:, None] ** 2 * gravity)

    def velocities(self, v_first: Array, gravity: Array) -> Array:
        return np.asarray(self.gained_mps + v_first + self.t_s[:, None] * gravity)

    def translation_residuals(self, seen: _SeenMotion) -> Array:
        """Return the known translations of the camera (M, 3) m less those that the specific force explains."""
        seen_m = (self.attitudes[:-1] @ seen.T_before_after[:, :3, 3:])[..., 0]
        return np.asarray((seen_m - np.diff(self.gained_m, axis=0))[seen.known])

    def velocity_that_fits(self, seen: _SeenMotion, gravity: Array) -> Array:
        """Return the first velocity (3,) m/s that explains the seen translations best; zero where none is known."""
        if not seen.known.any():
            return np.zeros(3)
        per_gravity = 0.5 * np.diff(self.t_s**2)[seen.known]
        per_velocity = np.diff(self.t_s)[seen.known, None, None] * np.eye(3)
        return _robust(per_velocity, self.translation_residuals(seen) - per_gravity[:, None] * gravity)[0]


def _gravity(path: _Path, seen: _SeenMotion, length: float) -> tuple[Array, str | None]:
    """Return gravity (3,) m/s^2 in the first frame, and the contradiction, if there is one."""
    down = -path.gained_mps[-1]
    contradiction = None
    if seen.known.sum() >= _FEWEST_INTERVALS:
        per_velocity, per_gravity = (np.diff(t)[seen.known] for t in (path.t_s, 0.5 * path.t_s**2))
        design = np.concatenate([per_velocity[:, None, None] * np.eye(3), per_gravity[:, None, None] * np.eye(3)], 2)
        found, cov = _robust(design, path.translation_residuals(seen))
        uncertain = _GRAVITY_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]))
        share = _GRAVITY_SHARE * length
        if uncertain < share:
            down, found_length = found[3:], float(np.linalg.norm(found[3:]))
            if abs(found_length - length) > share + uncertain:
                contradiction = f"stereo and accelerometer show a gravity of {found_length:.1f} m/s^2, not {length:.1f}"
    return length * down / max(float(np.linalg.norm(down)), 1e-9), contradiction


def _robust(design: Array, observed: Array) -> tuple[Array, Array]:
    """Solve design (N, 3, d) x = observed (N, 3) with Huber's weights; return x (d,) and its covariance (d, d).

    The scale is that of the median residual.
    """
    weights = np.ones(len(observed))
    size = design.shape[2]
    for _ in range(_REWEIGHTINGS):
        weighted = np.swapaxes(design, 1, 2) * weights[:, None, None]
        normal = (weighted @ design).sum(axis=0)
        solution = np.linalg.solve(normal, (weighted @ observed[..., None]).sum(axis=0)[:, 0])
        off2 = ((observed - design @ solution) ** 2).sum(axis=1)
        scale = max(float(np.sqrt(np.median(off2))) / _MEDIAN_NORM, 1e-12)
        weights = huber_weights(off2 / scale**2, _HUBER)
    freedom = max(3 * len(observed) - size, 1) / (3 * len(observed))
    return solution, np.linalg.inv(normal) * scale**2 / freedom


def levelling(up: Array) -> Array:
    """Return the least rotation (3, 3) that takes a direction (3,) to the z-axis; of straight down a half turn.

    No direction at all, as where an accelerometer reads zeros, is left as it is.
    """
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    half_turn = np.array([np.pi, 0.0, 0.0]) if up[2] < 0.0 else np.zeros(3)
    return so3_exp(axis / sine * np.arctan2(sine, up[2]) if sine > 1e-12 else half_turn)
