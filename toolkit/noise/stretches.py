"""Stretches of a recording, each adjusted as a whole: states and landmarks by all measurements in it.

A stretch is a smoother's window that holds all of its frames (:mod:`toolkit.models.stereo_adjustment`), with the
estimators' motion factors, the stereo sightings under Huber's loss, and a weak prior on the first state.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from toolkit.geometry import Array, IntArray
from toolkit.initialization import guess_with_imu
from toolkit.measurements import NS_PER_S, ImuMotion, MotionNoise, Packet, Prior, StereoRig
from toolkit.models import stereo
from toolkit.models.camera_motion import camera_motion
from toolkit.models.gating import chi2_bound
from toolkit.models.graph_state import MotionModel
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.models.stereo_adjustment import Ending, Evaluated, RobustCamera, StereoWindow, Vision, solve_window
from toolkit.sequence import Sequence

# A stretch has this many frames: most tracks end within it, and a dense matrix holds its states. There are as many
# stretches as the recording has room for, at most six.
FRAMES, MOST_STRETCHES = 30, 6
# Tracks a frame that are used, spread over image and depth: they determine the poses, and time grows with their number.
TRACKS = 100
# Probability of the chi-square bound beyond which, by the stated noise, a sighting is an outlier.
SOUND = 0.999
_ENDING = Ending(iterations=15)
# Huber's threshold (sigma), as in the start: the median norm of a sound whitened residual.
_HUBER = 1.5
# Standard deviations of the prior on the first state: attitude rad, position m, velocity m/s, biases m/s^2 and rad/s.
_PRIOR_COV = np.diag(np.repeat([0.1, 1e-3, 10.0, 0.1, 0.05], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a recording: its packets, a start of the state at each frame, and the share of its tracks in use."""

    gravity_world: Array
    packets: tuple[Packet, ...]
    start: tuple[Belief, ...]
    used: float

    @classmethod
    def of(cls, sequence: Sequence, first: int, count: int) -> "Stretch":
        whole = sequence.with_frames(np.arange(first, first + count))
        part = replace(whole, track_budget=min(TRACKS, sequence.track_budget or TRACKS))
        packets = tuple(part.packets())
        used = len(part.visible) / max(len(whole.visible), 1)
        return cls(part.gravity_world, packets, tuple(_started(part, packets)), used)

    def adjusted(self, rig: StereoRig, noise: MotionNoise) -> "Adjusted":
        """Return the stretch adjusted under a noise of sightings and motion, from its start.

        Raises EstimatorError where the measurements do not determine the states.
        """
        window, model = StereoWindow.empty(), motion_model(noise, self.gravity_world)
        for packet, state in zip(self.packets, self.start, strict=True):
            estimate, nothing = state.estimate(packet.frame.t_ns), gtsam.NonlinearFactorGraph()
            window = window.extended(model, estimate, nothing, packet.frame, packet.index, rig)
        window, _ = window.in_front(rig)
        return self._solved(window, model, rig)

    def adjusted_again(self, before: "Adjusted", rig: StereoRig, noise: MotionNoise) -> "Adjusted":
        """Return the stretch adjusted under another noise, by the sightings that were sound, from the solution before.

        Raises as :meth:`adjusted`.
        """
        return self._solved(before.by_sound_sightings(), motion_model(noise, self.gravity_world), rig)

    def _solved(self, window: StereoWindow, model: MotionModel, rig: StereoRig) -> "Adjusted":
        bias = model.read(window.values, len(self.packets) - 1, 0).bias
        assert bias is not None
        motion = tuple(
            model.hold(self.start[0], 0)
            if packet.motion is None
            else model.integrate(packet.motion, bias).factors(packet.index)
            for packet in self.packets
        )
        camera = RobustCamera(rig, _HUBER)
        solved = solve_window(replace(window, motion=motion), camera, _ENDING)
        return Adjusted(solved.window, camera)


def stretches(sequence: Sequence) -> Iterator[Stretch]:
    """Yield stretches of a recording with a budget of tracks, evenly spread over it."""
    frames = min(FRAMES, sequence.frame_count)
    count = min(sequence.frame_count // frames, MOST_STRETCHES)
    for i in range(count):
        yield Stretch.of(sequence, round((i + 0.5) / count * (sequence.frame_count - frames)), frames)


def _started(part: Sequence, packets: tuple[Packet, ...]) -> Iterator[Belief]:
    """Yield a start of the states: by vision and IMU together, or by two-view motions of the tracks, else as measured.

    The covariance of the first is that of the prior.
    """
    motions = [packet.motion for packet in packets if packet.motion is not None]
    measured = [motion for motion in motions if isinstance(motion, ImuMotion)]
    seen = replace(part, observations=part.visible, track_budget=None)
    model = motion_model(part.noise, part.gravity_world)
    state = model.initial_belief(Prior(np.eye(4), np.zeros(3), np.zeros(6), _PRIOR_COV, ""))
    if measured:
        guess = guess_with_imu(seen, measured)
        for pose, v_world in zip(guess.T_world_imu, guess.v_world, strict=True):
            yield replace(state, T_world_imu=pose, v_world=v_world, bias=guess.bias)
        return
    moved, dt_s = camera_motion(seen), np.diff(part.frames_t_ns) / NS_PER_S
    steps = moved.steps_of_imu(dt_s, part.rig.T_imu_cam)
    yield state
    for motion, step, known, lasting_s in zip(motions, steps, moved.known, dt_s, strict=True):
        prediction = model.integrate(motion, state.bias).predict(state)
        if known:
            v_world = state.T_world_imu[:3, :3] @ step[:3, 3] / lasting_s
            prediction = prediction._replace(T_world_imu=state.T_world_imu @ step, v_world=v_world)
        state = state.predicted(prediction)
        yield state


class MotionFit(NamedTuple):
    """How well n equations of the motion fit: their squared residuals, and what the states leave of them.

    At a solution the residuals of the equations have the covariance 1 - J A^-1 J^T if the noise is as stated, with
    their Jacobian J and the normal matrix A: ``expected`` is its trace and ``spread`` its squared norm, so that the
    squared residuals have the variance 2 ``spread``.
    """

    squares: float
    expected: float
    spread: float


class SoundResiduals(NamedTuple):
    """N plausible sightings: frame and track (N,), (uL, uR, v) (N, 3) px, whitened residuals (N, 3).

    ``H_pose`` (N, 3, 6) are the whitened Jacobians to the pose of the frame.
    """

    frame: IntArray
    track: IntArray
    uv_px: Array
    whitened: Array
    H_pose: Array


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A stretch at its minimum."""

    window: StereoWindow
    camera: RobustCamera

    @cached_property
    def _evaluated(self) -> Evaluated:
        return Evaluated.of(self.window, self.camera)

    @property
    def vision(self) -> Vision:
        return self._evaluated.vision

    def by_sound_sightings(self) -> StereoWindow:
        """Return the window with the sightings that are plausible by the stated noise, and the points they see."""
        vision, seen = self.vision, self.window.sightings
        bound = chi2_bound(stereo.degrees_of_freedom(seen.uv_px), SOUND)
        sound = (np.square(vision.whitened).sum(axis=1) < bound) & vision.in_front
        return self.window.with_sightings(sound)

    def residuals(self, fewest_sightings: int) -> SoundResiduals:
        """Return the residuals of the plausible sightings of tracks with ``fewest_sightings`` or more of them."""
        sound = replace(self, window=self.by_sound_sightings())
        vision, seen = sound.vision, sound.window.sightings
        often = np.bincount(seen.point, minlength=len(sound.window.points))[seen.point] >= fewest_sightings
        H_pose = vision.H_pose
        return SoundResiduals(
            seen.pose[often], seen.point[often], seen.uv_px[often], vision.whitened[often], H_pose[often]
        )

    def motion_fit(self) -> MotionFit:
        """Return how the motion samples fit the solution; the prior on the first state is left out."""
        keys, dims = self.window.all_keys, self.window.values.dims()
        columns = dict(zip(keys, np.cumsum([0, *(dims[key] for key in keys[:-1])]).tolist(), strict=True))
        rows, right = list[Array](), list[Array]()
        for graph in self.window.motion[1:]:
            linear = graph.linearize(self.window.values)
            for factor in map(linear.at, range(linear.size())):
                jacobian, offset = factor.jacobian()
                own = [columns[key] + np.arange(dims[key]) for key in factor.keys()]  # noqa: SIM118 - not a mapping
                row = np.zeros((len(offset), sum(dims[key] for key in keys)))
                row[:, np.concatenate(own)] = jacobian
                rows.append(row)
                right.append(offset)
        squares = np.square(np.concatenate(right))
        half = solve_triangular(self._evaluated.linearised().root, np.concatenate(rows).T, lower=True)
        cov = np.eye(len(squares)) - half.T @ half
        return MotionFit(float(squares.sum()), float(np.trace(cov)), float(np.square(cov).sum()))
