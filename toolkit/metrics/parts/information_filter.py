"""The forward information filter of the causal Cramér-Rao bound, over the state and the landmarks still to be seen.

Tichavsky, Muravchik & Nehorai 1998, "Posterior Cramér-Rao bounds for discrete-time nonlinear filtering". Under a stated
noise of tracks the error of each track due to walk and offset is a variable beside its landmark.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.metrics.parts.sound_sightings import SightingsByTrack
from toolkit.models import left_only, stereo
from toolkit.models.motion import MotionModel
from toolkit.models.state import POSE, Belief
from toolkit.sequence import Packet, StereoFrame
from toolkit.track_noise import TrackNoise

# Least standard deviation (px) of a track's error at its first sighting, so that its information is finite: a hundredth
# of the least white noise.
_LEAST_ERROR_PX = 1e-4
# Columns (n,), whitened Jacobian (m, n) and right side (m,) of linear equations with independent unit noise.
Equations = tuple[IntArray, Array, Array]


@dataclass(frozen=True, eq=False)
class LinearisedProblem:
    """The true states, the packets without mismatches, their sightings by track, and the landmarks (M, 3) of these."""

    model: MotionModel
    prior: Belief
    states: tuple[Belief, ...]
    packets: tuple[Packet, ...]
    sightings: SightingsByTrack
    points: Array

    def rows(self, frame: StereoFrame) -> IntArray:
        """Return the rows (N,) of the landmarks that a frame shows."""
        return np.searchsorted(self.sightings.track_ids, frame.track_ids)

    @property
    def poses(self) -> Array:
        """Return the true poses (K, 4, 4)."""
        return np.stack([state.T_world_imu for state in self.states])


class _Columns(NamedTuple):
    """Columns of one step's equations: first those that are marginalised, then landmarks, then the new state.

    ``before`` (n,) are those of the variables before the step, ``old_state`` (d,) and ``state`` (d,) those of the two
    states, the same at the first frame. A landmark has ``landmarks`` (L, 3 or 6), the last three for its track's error.
    ``walking`` (w,) are those of the errors that walk, as they were before the step.
    """

    marginalised: int
    before: IntArray
    old_state: IntArray
    state: IntArray
    landmarks: IntArray
    walking: IntArray


class InformationFilter:
    """The square root R of the information R^T R of the offsets from the truth, upper triangular, and R times the mean.

    Rows of new information are stacked below R and made triangular by Householder's QR (Bierman 1977, "Factorization
    methods for discrete sequential estimation", chapter 5): information itself loses all digits where steps are known
    far better than states. The offsets are those of each landmark, followed by the error of its track in channels
    (c, d, v) px where walk or offset is stated, and of the state.
    """

    def __init__(self, problem: LinearisedProblem) -> None:
        self._problem, self._size = problem, problem.prior.layout.size
        self._noise = problem.sightings.noise
        self._root = np.asarray(np.linalg.inv(np.linalg.cholesky(problem.prior.cov)))
        self._right: Array = self._root @ problem.states[0].error_to(problem.prior)
        self._landmarks = np.empty(0, dtype=np.int64)  # rows of the problem's landmarks
        self._leaving = np.empty(0, dtype=bool)  # those that are not seen again
        self._ages = np.empty(0, dtype=np.int64)  # at their last sightings
        self._per_landmark = 3 if self._noise.of_tracks is None else 6

    def step(self, packet: Packet) -> None:
        """Add the next state by the measured motion and the sightings of its frame, and marginalise the past."""
        frame, rows = packet.frame, self._problem.rows(packet.frame)
        joining = ~np.isin(rows, self._landmarks)
        landmarks = np.concatenate([self._landmarks[~self._leaving], rows[joining]])
        ages = np.concatenate([self._ages[~self._leaving], frame.ages[joining]])
        place = np.argsort(landmarks)[np.searchsorted(np.sort(landmarks), rows)]
        steps = np.zeros(len(landmarks), dtype=np.int64)
        steps[place] = frame.ages - ages[place]
        sigmas = self._walk_sigmas(steps)
        columns = self._columns(len(landmarks), sigmas > 0.0, has_moved=packet.motion is not None)
        joined = columns.landmarks[len(landmarks) - joining.sum() :]
        equations = [(columns.before, self._root, self._right), *self._motion(packet, columns)]
        if self._noise.of_tracks is not None:
            equations += _walk(sigmas[sigmas > 0.0], columns, columns.landmarks[:, 3:][sigmas > 0.0])
            prior = np.diag(1.0 / np.sqrt(_error_variance(self._noise.of_tracks, frame.ages[joining])).ravel())
            equations.append((joined[:, 3:].ravel(), prior, np.zeros(len(prior))))
        equations += self._sightings(packet, columns.state, columns.landmarks[place])
        self._root, self._right = _triangular(equations, columns.state[-1] + 1, columns.marginalised)
        ages[place] = frame.ages
        self._landmarks, self._ages, self._leaving = landmarks, ages, np.zeros(len(landmarks), dtype=bool)

    def state(self) -> tuple[Array, Array]:
        """Return the covariance (d, d) and the mean (d,) of the state's offset."""
        root = np.linalg.inv(self._root[-self._size :, -self._size :])
        return root @ root.T, root @ self._right[-self._size :]

    def forget(self, gone: BoolArray) -> None:
        """Marginalise landmarks that are not seen again: ``gone`` (M,) masks the problem's landmarks."""
        self._leaving = gone[self._landmarks]

    def _walk_sigmas(self, steps: IntArray) -> Array:
        """Return the standard deviations (L, 3) px of the walk in some frames (L,), or (L, 0) if errors are white."""
        noise = self._noise.of_tracks
        return np.empty((len(steps), 0)) if noise is None else noise.walk_px * np.sqrt(steps[:, None])

    def _columns(self, count: int, walks: BoolArray, has_moved: bool) -> _Columns:
        """Return the columns with ``count`` landmarks, of whose tracks' errors some walk (L, 3 or 0)."""
        d, each = self._size, self._per_landmark
        gone = each * int(self._leaving.sum())
        marginalised = gone + has_moved * d + int(walks.sum())
        landmarks = marginalised + np.arange(each * count).reshape(count, each)
        state = marginalised + each * count + np.arange(d)
        old_state = gone + np.arange(d) if has_moved else state
        walking = gone + has_moved * d + np.arange(walks.sum())
        old = landmarks.copy()
        old[:, 3:][walks] = walking
        before = np.empty((len(self._leaving), each), dtype=np.int64)
        before[self._leaving] = np.arange(gone).reshape(-1, each)
        before[~self._leaving] = old[: int((~self._leaving).sum())]
        return _Columns(marginalised, np.concatenate([before.ravel(), old_state]), old_state, state, landmarks, walking)

    def _motion(self, packet: Packet, columns: _Columns) -> Iterator[Equations]:
        """Yield the equations of the measured motion between two states, none at the first frame."""
        if packet.motion is None:
            return
        before, now = self._problem.states[packet.index - 1], self._problem.states[packet.index]
        increment = self._problem.model.integrate(packet.motion, before.bias)
        prediction = increment.predict(before)
        # Linearised at the true end, not at the predicted one, so that unobservable directions gain no information.
        at_truth = prediction._replace(T_world_imu=now.T_world_imu, v_world=now.v_world)
        transition = increment.transition_between(before, at_truth)
        whitener = np.linalg.inv(np.linalg.cholesky(prediction.noise))
        # By the measured motion the next state's offset is F x + r plus noise.
        r = now.error_to(before.predicted(prediction))
        jacobian = np.hstack([-whitener @ transition, whitener])
        yield np.concatenate([columns.old_state, columns.state]), jacobian, whitener @ r

    def _sightings(self, packet: Packet, state: IntArray, landmarks: IntArray) -> Iterator[Equations]:
        """Yield the equations of each sighting; ``landmarks`` (N, 3 or 6) are their columns."""
        frame, rig = packet.frame, self._noise.rig
        pose = self._problem.states[packet.index].T_world_imu
        seen = stereo.predict(self._problem.points[self._problem.rows(frame)], pose, rig)
        whitener = left_only.whitener(frame.uvs_px, rig)
        blocks = [whitener @ seen.d_uv_d_pose, whitener @ seen.d_uv_d_point]
        if self._noise.of_tracks is not None:
            blocks.append(self._noise.d_white_d_error(frame.uvs_px))
        residuals = left_only.whitened_residuals(frame.uvs_px, seen.uv_px, rig)
        for jacobian, own, residual in zip(np.concatenate(blocks, axis=2), landmarks, residuals, strict=True):
            yield np.concatenate([state[POSE], own]), jacobian, residual


def _walk(sigmas: Array, columns: _Columns, walked: IntArray) -> Iterator[Equations]:
    """Yield the equations of errors (w,) that walk with some standard deviations to their columns after the step."""
    apart = np.diag(1.0 / sigmas)
    yield np.concatenate([columns.walking, walked]), np.hstack([-apart, apart]), np.zeros(len(sigmas))


def _triangular(equations: Sequence[Equations], size: int, marginalised: int) -> tuple[Array, Array]:
    """Return the triangular root and right side of equations on ``size`` variables, without the marginalised first."""
    stacked = np.zeros((sum(len(right) for *_, right in equations), size + 1))
    start = 0
    for columns, jacobian, right in equations:
        rows = slice(start, start + len(right))
        stacked[rows, columns], stacked[rows, -1] = jacobian, right
        start = rows.stop
    root = np.asarray(np.linalg.qr(stacked, mode="r"))[marginalised:size]
    return root[:, marginalised:-1], root[:, -1]


def _error_variance(noise: TrackNoise, ages: IntArray) -> Array:
    """Return the variance (N, 3) px^2 of the errors of tracks due to walk and offset at ages (N,)."""
    walked = np.square(noise.walk_px) * ages[:, None].astype(float)
    return np.asarray(np.square(noise.offset_px) + walked + _LEAST_ERROR_PX**2)
