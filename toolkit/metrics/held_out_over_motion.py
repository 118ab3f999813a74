"""The ratio of held-out reprojection to that of the measured motion alone, track by track: shows whether vision helped.

An estimator corrects the measured motion by the tracks that it is given. If it predicts withheld tracks worse than the
motion alone, its corrections were wrong or, in a causal output, jump back and forth by more than they gain, whatever
its covariance. The motion is integrated from the output's own first state. Errors are paired over the tracks, which
differ far more from each other than two estimates of one track do.
"""

from typing import NamedTuple

import numpy as np

from toolkit.estimate import Landmarks, Run, Trajectory
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.leave_one_out import FEWEST_VIEWS, errors_left_out
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable
from toolkit.models.corrections import belief_at, integrated
from toolkit.models.motion import motion_model
from toolkit.sequence import Sequence

ORDER = 61
RATIO, ERROR = "heldout_over_motion", "heldout_over_motion_error"
# Added to both errors, in squares, so that differences far below a tenth of a pixel, as without noise, do not count.
_FLOOR_PX = 0.1
# This many tracks, drawn evenly, give the ratio to a few percent; with fewer than the second number it is not computed.
_MOST_TRACKS, _FEWEST_TRACKS = 1000, 30
# Vision did harm if a run is worse by the first factor, or by the second in the worst of ten stretches, in both cases
# by more than this many standard errors. In 365 sound simulated runs the ratio is at most 1.03 with twists, and 2.0
# with an IMU, which is smoother from frame to frame than a corrected causal output. Chosen by looking at these runs.
MOST_RATIO, MOST_RATIO_OF_STRETCH, SIGMAS = {"twist": 1.25, "imu": 2.5}, {"twist": 2.0, "imu": 4.0}, 5.0
_STRETCHES, _FEWEST_IN_STRETCH = 10, 10
_OF_CAUSAL = ": look for wrong tracks, or corrections it takes back later"
_OF_FINAL = ": look for wrong tracks or a wrong calibration"
METRICS = (
    Metric(
        RATIO,
        "held-out error over that of the measured motion alone (geometric mean over tracks); below 1 vision has helped",
        "1",
        ("held-out", "/ motion"),
    ),
    Metric(
        ERROR,
        "standard error, over the tracks, of the logarithm of held-out / motion",
        "1",
        ("held-out", "/motion +-"),
        name="held-out / motion, error",
    ),
)


class _Paired(NamedTuple):
    """For n tracks the logarithm (n,) of the ratio of two errors, and the mean time (n,) s of their sightings."""

    log_ratio: Array
    t_s: Array


def score(evaluation: Evaluation) -> Scores:
    """Score the ratio of the errors of withheld tracks under the evaluated poses to those under the motion alone.

    If vision did harm, a remark on the ratio says so, and in which stretch most.
    """
    paired = _paired(evaluation)
    ratio, error = _mean(paired.log_ratio)
    harm = _harm(paired, evaluation.sequence.motion_kind)
    if harm:
        harm += _OF_CAUSAL if evaluation.output == "causal" else _OF_FINAL
    scores = Scores({RATIO: float(np.exp(ratio)), ERROR: error})
    return scores.remarked((RATIO,), harm)


def _paired(evaluation: Evaluation) -> _Paired:
    """Return the ratios of the errors of withheld tracks to those under the measured motion alone."""
    sequence = evaluation.sequence
    motion = _motion_alone(evaluation.estimate, sequence)
    seen, errors_px = evaluation.held_out_errors
    drawn = _of_some_tracks(sequence.held_out.track_id[seen])
    tracks, errors_px = sequence.held_out.select(seen[drawn]), errors_px[drawn]
    poses_by_motion = Evaluation(motion, "causal", sequence).poses_of_frames
    _, by_motion_px = errors_left_out(tracks, poses_by_motion, sequence.rig)
    ids, track, count = np.unique(tracks.track_id, return_inverse=True, return_counts=True)
    if ids.size < _FEWEST_TRACKS or by_motion_px.size != errors_px.size:
        raise Unavailable(
            f"{ids.size} withheld tracks have {FEWEST_VIEWS} views from frames with a pose; {_FEWEST_TRACKS} are needed"
        )
    apart = 0.5 * np.log((errors_px**2 + _FLOOR_PX**2) / (by_motion_px**2 + _FLOOR_PX**2))
    t_s = sequence.frames_s[tracks.frame]
    return _Paired(np.bincount(track, apart) / count, np.bincount(track, t_s) / count)


def _motion_alone(estimate: Trajectory, sequence: Sequence) -> Run:
    """Return a run that integrates the measured motion from the first state of an estimate."""
    if sequence.motion_kind == "none":
        raise Unavailable("no motion was measured")
    if sequence.motion_kind == "imu" and estimate.v_world is None:
        raise Unavailable("the output states no velocity that the motion of an IMU could be integrated from")
    packets = [packet for packet in sequence.packets() if len(estimate) and packet.frame.t_ns >= estimate.t_ns[0]]
    if not packets:
        raise Unavailable("there is no pose to integrate the motion from")
    model = motion_model(sequence.noise, sequence.gravity_world)
    motions = [packet.motion for packet in packets[1:] if packet.motion is not None]
    belief = belief_at(estimate, 0, model)
    poses = [belief.T_world_imu]
    for increment in integrated(model, motions, [belief.bias] * len(motions)):
        belief = belief.predicted(increment.predict(belief))
        poses.append(belief.T_world_imu)
    motion = Trajectory(np.array([packet.frame.t_ns for packet in packets], dtype=np.int64), np.array(poses))
    return Run("the measured motion", "ok", motion, None, Landmarks.none(), timings=None)


def _of_some_tracks(track_ids: IntArray) -> BoolArray:
    """Say which sightings (N,) belong to an even draw of at most ``_MOST_TRACKS`` tracks."""
    ids = np.unique(track_ids)
    some = ids[np.linspace(0, ids.size - 1, min(ids.size, _MOST_TRACKS)).round().astype(int)]
    return np.isin(track_ids, some)


def _harm(paired: _Paired, kind: str) -> str:
    """Return by how much, and in which stretch most, vision did harm; empty if it did not."""
    whole, notes = _mean(paired.log_ratio), list[str]()
    if _least(whole) > np.log(MOST_RATIO[kind]):
        ratio = float(np.exp(whole[0]))
        notes.append(f"{ratio:.2f} +- {ratio * whole[1]:.2f} times ({paired.t_s.size} tracks)")
    edges = np.linspace(paired.t_s.min(), paired.t_s.max(), _STRETCHES + 1)
    stretch = np.clip(np.searchsorted(edges, paired.t_s, side="right") - 1, 0, _STRETCHES - 1)
    many = [k for k in range(_STRETCHES) if np.count_nonzero(stretch == k) >= _FEWEST_IN_STRETCH]
    of_stretch = {k: _mean(paired.log_ratio[stretch == k]) for k in many}
    worst = max(many, key=lambda k: _least(of_stretch[k]), default=None)
    if worst is not None and _least(of_stretch[worst]) > np.log(MOST_RATIO_OF_STRETCH[kind]):
        notes.append(f"{np.exp(of_stretch[worst][0]):.2g} times at {edges[worst]:.0f}-{edges[worst + 1]:.0f} s")
    if not notes:
        return ""
    return f"explains withheld tracks worse than dead reckoning, with {', '.join(notes)} its error"


def _mean(values: Array) -> tuple[float, float]:
    """Return the mean of values (n,) and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size))


def _least(mean: tuple[float, float]) -> float:
    return mean[0] - SIGMAS * mean[1]
