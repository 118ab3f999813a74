"""Finds tracks that move against the measured motion and most other tracks: on vehicles, fixed in the image, slipped.

This is decided frame by frame from the past alone, before any estimator runs, and is the same for all. A filter of the
motion, with the state that estimators have, predicts the motion since the frame before with its covariance. Every track
is predicted from its last accepted sighting; its residual, whitened by the noise of both sightings, is linear in the
error of the motion. The motion is the most probable one by truncated least squares: a track counts by its chi-square,
at most by the bound. A motion that the covariance of the prediction excludes is not taken, so that a consensus of
vehicles cannot be mistaken for the motion where odometry disagrees, unless nine tracks in ten agree. The search starts
at the prediction and lowers the weight of residuals beyond the bound step by step (Black & Rangarajan 1996, "On the
unification of line processes, outlier rejection, and robust statistics in early vision") and, where that leaves many
tracks out, also tries the motions that three tracks determine (Fischler & Bolles 1981, "Random sample consensus").

Each track is then tested once more from a sighting some frames ago, along the motions found since. This test finds
vehicles that are too slow, or too far away, to be found from one frame to the next.

A sighting beyond the bound in either test is left out; a track refused in three successive frames stays out for the
rest of its life. Where fewer than half of the tracks agree, motion or noise are not as stated, and no track is refused.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, se3_adjoint, se3_exp, se3_inverse, skew, transform, transposed
from toolkit.measurements import Packet, Prior, StereoRig, is_left_only
from toolkit.models.camera_motion import RIDGE
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, MOST_MISMATCHED, chi2_bound, mahalanobis_squared
from toolkit.models.motion import motion_model
from toolkit.models.state import POSE, Belief, Prediction
from toolkit.models.stereo import disparity_px, project, projection_jacobian, triangulate
from toolkit.sequence import Sequence, is_held_out

# One in a thousand sound sightings is rejected, and one in a thousand correct motions is taken to be impossible.
PROBABILITY = 0.999
# A track refused in this many successive frames stays out; a single bad sighting spoils one frame.
REFUSALS = 3
# A track is tested from its last accepted sighting and from one about this many frames ago, where slow motion shows.
EARLY_FRAMES = 5
_MOST_FRAMES_BACK = EARLY_FRAMES + REFUSALS + 1
# Where a larger share of tracks than this disagrees with the motion found from the prediction, others are searched.
_SEARCHED_BEYOND = 0.1
_SAMPLES, _SAMPLE, _REFINED = 24, 3, 3
# Residuals, in multiples of the bound, beyond which a track has less than a quarter of its weight, one after another.
_SOFTENED = (4.0, 1.0)
# Error that the linear model may neglect, in standard deviations of a pixel coordinate.
_NEGLIGIBLE_SIGMAS = 0.2


class LeftOut(NamedTuple):
    """How many sightings and tracks are left out, and of how many; frames in which too few tracks agreed."""

    sightings: int
    of_sightings: int
    tracks: int
    of_tracks: int
    undecided_frames: int


def without_moving_tracks(sequence: Sequence, prior: Prior) -> tuple[Sequence, LeftOut]:
    """Return the sequence without the sightings that move against the rest, and the counts of these.

    Tracks that are held out of estimation stay as they are. Raises DataError where the sequence cannot be run.
    """
    seen = sequence.observations
    visible = ~is_held_out(seen.track_id)
    check = MovingTracks(sequence, prior)
    kept = np.ones(len(seen), dtype=bool)
    kept[visible] = np.concatenate([check.sound(packet) for packet in replace(sequence, track_budget=None).packets()])
    gone, tracks = np.unique(seen.track_id[~kept]), np.unique(seen.track_id[visible])
    counts = LeftOut(int((~kept).sum()), int(visible.sum()), gone.size, tracks.size, check.undecided_frames)
    return replace(sequence, observations=seen.select(kept)), counts


class MovingTracks:
    """Decides which of each packet's sightings are sound, from this packet and those before."""

    def __init__(self, sequence: Sequence, prior: Prior) -> None:
        self._rig, self._model = sequence.rig, motion_model(sequence.noise, sequence.gravity_world)
        self._belief: Belief = self._model.initial_belief(prior)
        self._rng = np.random.default_rng(0)
        self._tracks = _Tracks.begun(np.empty(0, dtype=np.int64), np.empty((0, 3)), -1)
        # The pose at each of the last frames, by the estimated motions; and the covariance of the last of these.
        self._path = {-1: np.eye(4)}
        self._step_cov = np.zeros((6, 6))
        self.undecided_frames = 0

    def sound(self, packet: Packet) -> BoolArray:
        """Return which sightings (N,) of the packet are given to estimators."""
        frame, k = packet.frame, packet.index
        order = np.argsort(frame.track_ids)
        seen = _Tracks.begun(frame.track_ids[order], frame.uvs_px[order], k).continuing(self._tracks)
        self._path[k] = self._path[k - 1]
        agree = None
        if packet.motion is not None:
            prediction = self._model.integrate(packet.motion, self._belief.bias).predict(self._belief)
            agree = self._take(_Step.of(self._belief, prediction), prediction, seen)
        self._path.pop(k - _MOST_FRAMES_BACK, None)
        self._tracks = seen.checked(agree)
        sound = np.empty(order.size, dtype=bool)
        sound[order] = self._tracks.refusals < (REFUSALS if agree is None else 1)
        return sound

    def _take(self, step: "_Step", prediction: Prediction, seen: "_Tracks") -> BoolArray | None:
        """Update the filter with the motion that the tracks agree on; return which agree, None if too few do.

        Tracks that are not tested count as agreeing.
        """
        tested = (seen.refusals < REFUSALS) & seen.recent.can_predict(seen.now) & _deep(seen.uvs_px)
        found = _found(self._pairs(seen, seen.recent, tested), step, self._rig, self._rng)
        enough = found.agree.sum() >= (1.0 - MOST_MISMATCHED) * found.agree.size
        motion = found if enough else _FoundMotion(np.zeros(6), step.cov, found.agree)
        T_start_end = step.T_start_end @ se3_exp(motion.error)
        self._path[seen.now] = self._path[seen.now - 1] @ T_start_end
        self._belief = step.conditioned(self._belief.predicted(prediction), motion)
        if enough:
            agree = np.ones(tested.size, dtype=bool)
            agree[tested] = found.agree
            early = tested & seen.early.can_predict(seen.now) & (seen.early.frames < seen.recent.frames)
            linear = self._pairs(seen, seen.early, early).linear(T_start_end, self._rig)
            agree[early] &= linear.chi2(np.zeros(6), motion.cov) < chi2_bound(3, PROBABILITY)
        else:
            self.undecided_frames += 1
            agree = None
        self._step_cov = motion.cov
        return agree

    def _pairs(self, seen: "_Tracks", begun: "_EarlierSightings", which: BoolArray) -> "_Pairs":
        """Return some tracks as points (N, 3) m in the body at the previous frame, from their earlier sightings."""
        before, rig = seen.now - 1, self._rig
        frames, row = np.unique(begun.frames[which], return_inverse=True)
        T_before_begun = np.array([se3_inverse(self._path[before]) @ self._path[i] for i in frames.tolist()])
        T_before_cam = (T_before_begun.reshape(-1, 4, 4) @ rig.T_imu_cam)[row]
        points_cam = triangulate(begun.uvs_px[which], rig)
        d_point_d_uv = T_before_cam[:, :3, :3] @ np.linalg.inv(projection_jacobian(points_cam, rig))
        steps = (before - frames)[row][:, None, None]
        return _Pairs(transform(T_before_cam, points_cam), d_point_d_uv, seen.uvs_px[which], steps * self._step_cov)


class _EarlierSightings(NamedTuple):
    """The sightings (N, 3) px from which tracks are predicted, and their frames (N,)."""

    uvs_px: Array
    frames: IntArray

    def can_predict(self, now: int) -> BoolArray:
        """Say which (N,) are of an earlier frame and have a known depth."""
        return np.asarray((self.frames < now) & _deep(self.uvs_px))

    def with_those(self, others: "_EarlierSightings", rows: IntArray, places: IntArray) -> "_EarlierSightings":
        """Return the sightings with rows (M,) of others at some indices (M,)."""
        uvs_px, frames = self.uvs_px.copy(), self.frames.copy()
        uvs_px[places], frames[places] = others.uvs_px[rows], others.frames[rows]
        return _EarlierSightings(uvs_px, frames)

    def moved_on(self, seen: "_Tracks", sound: BoolArray, most_frames: int) -> "_EarlierSightings":
        """Replace sightings of a certain age by the present ones: by accepted ones first, later by any."""
        age = seen.now - self.frames
        late = (sound & (age >= most_frames)) | (age >= most_frames + REFUSALS) | ~_deep(self.uvs_px)
        return _EarlierSightings(
            np.where(late[:, None], seen.uvs_px, self.uvs_px), np.where(late, seen.now, self.frames)
        )


@dataclass(frozen=True, eq=False)
class _Tracks:
    """The tracks of frame ``now``: ids (N,) ascending, sightings (N, 3) px, successive rejections (N,).

    ``recent`` and ``early`` are the sightings from which they are predicted.
    """

    now: int
    ids: IntArray
    uvs_px: Array
    recent: _EarlierSightings
    early: _EarlierSightings
    refusals: IntArray

    @classmethod
    def begun(cls, ids: IntArray, uvs_px: Array, k: int) -> "_Tracks":
        """Return tracks that begin with frame k."""
        here = _EarlierSightings(uvs_px, np.full(ids.size, k))
        return cls(k, ids, uvs_px, here, here, np.zeros(ids.size, dtype=np.int64))

    def continuing(self, before: "_Tracks") -> "_Tracks":
        """Return the tracks, with the history of those that were in the frame before."""
        _, old, new = np.intersect1d(before.ids, self.ids, assume_unique=True, return_indices=True)
        recent, early = self.recent.with_those(before.recent, old, new), self.early.with_those(before.early, old, new)
        refusals = self.refusals.copy()
        refusals[new] = before.refusals[old]
        return replace(self, recent=recent, early=early, refusals=refusals)

    def checked(self, agree: BoolArray | None) -> "_Tracks":
        """Return the tracks updated by which of them (N,) agree; None if that is undecided."""
        refusals = self.refusals
        if agree is not None:
            refusals = np.where((refusals < REFUSALS) & agree, 0, np.minimum(refusals + 1, REFUSALS))
        sound = refusals == 0
        recent, early = self.recent.moved_on(self, sound, 1), self.early.moved_on(self, sound, EARLY_FRAMES)
        return replace(self, recent=recent, early=early, refusals=refusals)


def _deep(uvs_px: Array) -> BoolArray:
    """Say which sightings (N, 3) have a known depth."""
    return np.asarray(~is_left_only(uvs_px) & (disparity_px(uvs_px) > LEAST_DISPARITY_PX))


class _FoundMotion(NamedTuple):
    """The error (6,) of a predicted motion, its covariance (6, 6), and which of the tracks (N,) agree with it."""

    error: Array
    cov: Array
    agree: BoolArray


class _Step(NamedTuple):
    """A predicted motion (4, 4), its error's covariance (6, 6) at its end, and that with the state there (d, 6)."""

    T_start_end: Array
    cov: Array
    cov_with_state: Array

    @classmethod
    def of(cls, start: Belief, end: Prediction) -> "_Step":
        """Return the motion of a prediction; its error is that of the end minus the propagated error of the start."""
        T_start_end = se3_inverse(start.T_world_imu) @ end.T_world_imu
        d_step = end.transition[POSE].copy()
        d_step[:, POSE] -= se3_adjoint(se3_inverse(T_start_end))
        carried = start.cov @ d_step.T
        cov = d_step @ carried + end.noise[POSE, POSE]
        if not (np.isfinite(cov).all() and np.isfinite(T_start_end).all()):
            raise DataError(
                "the measured motion is too large to find moving tracks by it; run without leave_out_moving"
            )
        return cls(T_start_end, 0.5 * (cov + cov.T), end.transition @ carried + end.noise[:, POSE])

    def conditioned(self, end: Belief, found: _FoundMotion) -> Belief:
        """Return the belief at the end, given the estimated error of the motion."""
        gain = np.linalg.solve(self.cov, self.cov_with_state.T).T
        return end.moved(gain @ found.error, end.cov - gain @ (self.cov - found.cov) @ gain.T)


class _Pairs(NamedTuple):
    """Points (N, 3) m in the body at the start of a step, their derivatives (N, 3, 3) by their first sightings.

    ``uvs_px`` (N, 3) are their sightings at its end, ``path_cov`` (N, 6, 6) the covariance of the path to the start.
    """

    points: Array
    d_point_d_uv: Array
    uvs_px: Array
    path_cov: Array

    def linear(self, T_start_end: Array, rig: StereoRig) -> "_Linear":
        """Return the residuals of the sightings under a motion, linearised."""
        T_end_start = se3_inverse(T_start_end)
        points = transform(T_end_start, self.points)
        points_cam = transform(rig.T_cam_imu, points)
        points_cam[:, 2] = np.maximum(points_cam[:, 2], LEAST_DEPTH_M)
        d_uv_d_point = projection_jacobian(points_cam, rig) @ rig.T_cam_imu[:3, :3]
        # A step [phi, rho] on the right of the motion moves a point p at its end by [p]x phi - rho.
        d_uv_d_motion = np.concatenate([d_uv_d_point @ skew(points), -d_uv_d_point], axis=2)
        d_uv_d_before = d_uv_d_point @ T_end_start[:3, :3] @ self.d_point_d_uv
        cov = rig.cov_uv_px2 + d_uv_d_before @ rig.cov_uv_px2 @ transposed(d_uv_d_before)
        cov += RIDGE * np.trace(cov, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        if self.path_cov.any():
            cov = cov + d_uv_d_motion @ self.path_cov @ transposed(d_uv_d_motion)
        return _Linear(self.uvs_px - project(points_cam, rig), cov, d_uv_d_motion)


class _Linear(NamedTuple):
    """Residuals (N, 3) px, their covariances (N, 3, 3), and Jacobians (N, 3, 6) of the predictions.

    The Jacobians are to an error on the right of the motion.
    """

    residual_px: Array
    cov: Array
    d_uv_d_motion: Array

    def chi2(self, error: Array, error_cov: Array) -> Array:
        """Return the squared residuals (N,) about a motion with the given error (6,) and its covariance (6, 6)."""
        spread = self.cov + self.d_uv_d_motion @ error_cov @ transposed(self.d_uv_d_motion)
        return mahalanobis_squared(self.residual_px - self.d_uv_d_motion @ error, spread)


def _found(pairs: _Pairs, step: _Step, rig: StereoRig, rng: np.random.Generator) -> _FoundMotion:
    """Return the motion that most tracks agree on, among those that the prediction does not exclude."""
    root = np.linalg.cholesky(step.cov + 1e-12 * np.trace(step.cov) * np.eye(6))
    bound, most = float(chi2_bound(3, PROBABILITY)), float(chi2_bound(6, PROBABILITY))
    linear = pairs.linear(step.T_start_end, rig)
    problem = _Problem.of(linear, root)
    best = _softened(problem, bound)
    if (problem.chi2(best[None])[0] < bound).sum() < (1.0 - _SEARCHED_BEYOND) * len(problem.residuals):
        best = _searched(problem, best, bound, most, rng)
    error = root @ best
    moved_px = np.abs(linear.d_uv_d_motion @ error).max(initial=0.0)
    # The error of the linear model is about the square of the shift over the focal length.
    if moved_px**2 > _NEGLIGIBLE_SIGMAS * np.sqrt(rig.cov_uv_px2[0, 0]) * rig.fx_px:
        linear = pairs.linear(step.T_start_end @ se3_exp(error), rig)
        linear = linear._replace(residual_px=linear.residual_px + linear.d_uv_d_motion @ error)
        problem = _Problem.of(linear, root)
    best, left = problem.solution(problem.chi2(best[None])[0] < bound)
    error, error_cov = root @ best, root @ left @ root.T
    return _FoundMotion(error, error_cov, linear.chi2(error, error_cov) < bound)


class _Problem(NamedTuple):
    """Whitened residuals (N, 3) and Jacobians (N, 3, 6), linear in an error of the motion of unit covariance."""

    residuals: Array
    jacobians: Array

    @classmethod
    def of(cls, linear: _Linear, root: Array) -> "_Problem":
        """Return the problem in units of the motion's uncertainty; ``root`` (6, 6) is that of its covariance."""
        whitener = np.linalg.inv(np.linalg.cholesky(linear.cov))
        return cls((whitener @ linear.residual_px[..., None])[..., 0], whitener @ (linear.d_uv_d_motion @ root))

    def chi2(self, errors: Array) -> Array:
        """Return the squared residuals (C, N) of C errors (C, 6)."""
        predicted = (self.jacobians.reshape(-1, 6) @ errors.T).reshape(-1, 3, len(errors))
        return np.asarray(((self.residuals[..., None] - predicted) ** 2).sum(axis=1).T)

    def costs(self, errors: Array, bound: float) -> Array:
        """Return the truncated squared residuals (C,) of C errors (C, 6), all tracks and the prediction together."""
        return np.asarray((errors**2).sum(axis=1) + np.minimum(self.chi2(errors), bound).sum(axis=1))

    def solution(self, weights: Array | BoolArray) -> tuple[Array, Array]:
        """Return the most probable error (6,) for weights of tracks (N,), and its covariance (6, 6)."""
        weighted = (self.jacobians * np.asarray(weights, dtype=float)[:, None, None]).reshape(-1, 6).T
        cov = np.linalg.inv(np.eye(6) + weighted @ self.jacobians.reshape(-1, 6))
        return cov @ (weighted @ self.residuals.reshape(-1)), cov


def _softened(problem: _Problem, bound: float) -> Array:
    """Return the error (6,) found starting from zero, with the weights of large residuals lowered step by step."""
    error = np.zeros(6)
    for factor in _SOFTENED:
        error, _ = problem.solution((1.0 + problem.chi2(error[None])[0] / (factor * bound)) ** -2)
    return problem.solution(problem.chi2(error[None])[0] < bound)[0]


def _searched(problem: _Problem, best: Array, bound: float, most: float, rng: np.random.Generator) -> Array:
    """Return the error (6,) of least cost: the given one, zero, or a possible one determined by three tracks."""
    size = min(_SAMPLE, len(problem.residuals))
    rows = rng.random((_SAMPLES, len(problem.residuals))).argpartition(size - 1, axis=1)[:, :size]
    of_samples = problem.jacobians[rows].reshape(_SAMPLES, -1, 6)
    normal = np.eye(6) + transposed(of_samples) @ of_samples
    gradient = transposed(of_samples) @ problem.residuals[rows].reshape(_SAMPLES, -1, 1)
    shown = np.asarray(np.linalg.solve(normal, gradient)[..., 0], dtype=np.float64)
    agree = problem.chi2(shown) < bound
    refined = [problem.solution(agree[i])[0] for i in problem.costs(shown, bound).argsort()[:_REFINED]]
    errors = np.stack([np.zeros(6), best, *refined])
    costs = np.where((errors**2).sum(axis=1) < most, problem.costs(errors, bound), np.inf)
    return np.asarray(errors[costs.argmin()])
