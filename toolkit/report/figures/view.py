"""The world from above: what of it a figure shows, and where the lines in it cannot be told apart."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from toolkit.estimate import Run
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array, IntArray
from toolkit.report.curves import onto_truth, shown_output, truth_during

_LANDMARK_QUANTILES = (0.02, 0.98)
_MARGIN = 0.05
# Landmarks widen the view by at most this share of the tracks' extent, and by this much where the camera hardly moved.
_LANDMARK_REACH = 0.5
_LEAST_REACH_M = 30.0
# Lines closer than this share of the view are one line to the eye.
_COINCIDE = 0.015
_LEAST_ZOOM = 1e-4
NOWHERE: Array = np.empty((0, 2))


class View(NamedTuple):
    """The rectangle from ``low`` (2,) to ``high`` (2,), x and y in metres."""

    low: Array
    high: Array

    @property
    def size(self) -> Array:
        """Return width and height (2,) in metres."""
        return self.high - self.low

    @property
    def ratio(self) -> float:
        """Return the height over the width."""
        return float(self.size[1] / self.size[0])

    def show(self, axes: Axes) -> None:
        """Have axes show this, in equal scale."""
        axes.set_xlim(self.low[0], self.high[0])
        axes.set_ylim(self.low[1], self.high[1])
        axes.set_aspect("equal", adjustable="box")


class PathFromAbove(NamedTuple):
    """Positions from above (N, 2) m at stamps (N,)."""

    t_ns: IntArray
    xy: Array


def from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    above: Array = (finite @ alignment.rotation.T + alignment.translation)[:, :2]
    return above


def track_of(comparison: Comparison, run: Run) -> PathFromAbove:
    """Return a run's last word from above, without poses that are not finite; the run must have a trajectory."""
    trajectory = run.trajectory(shown_output(run))
    assert trajectory is not None, "only runs with a trajectory are drawn"
    finite = np.isfinite(trajectory.positions).all(axis=1)
    return PathFromAbove(trajectory.t_ns[finite], from_above(comparison, run, trajectory.positions))


def true_track(comparison: Comparison) -> PathFromAbove | None:
    """Return the truth from above while the camera ran, or None."""
    truth = truth_during(comparison.sequence)
    return None if truth is None else PathFromAbove(truth.t_ns, truth.T_world_imu[:, :2, 3])


def landmarks_shown(points: Array) -> Array:
    """Return the corners (2, 2) of the range that holds all but the farthest of points (M, 2), or nothing."""
    if not points.shape[0]:
        return NOWHERE
    corners: Array = np.quantile(points, _LANDMARK_QUANTILES, axis=0)
    return corners


def view_of(tracks: Sequence[PathFromAbove], landmarks: Array) -> View:
    """Return the view of all of the tracks and of landmarks (M, 2) near them."""
    track = np.vstack([NOWHERE, *(one.xy for one in tracks)])
    if not track.size:
        track = np.zeros((1, 2))
    reach = max(_LANDMARK_REACH * float(np.ptp(track, axis=0).max()), _LEAST_REACH_M)
    shown = np.vstack([track, np.clip(landmarks, track.min(axis=0) - reach, track.max(axis=0) + reach)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), 0.5)
    return View(low - margin, high + margin)


def where_tracks_coincide(tracks: Sequence[PathFromAbove], view: View, at_ns: IntArray) -> View | None:
    """Return a square around the place to look closer at: where most tracks are one line, and differ most in it.

    Returns None where no two of them ever are.
    """
    there = [track for track in tracks if track.t_ns.size]
    if len(there) < 2 or not at_ns.size:
        return None
    xy = np.stack([_at(track, at_ns) for track in there])
    with np.errstate(all="ignore"):
        off = np.linalg.norm(xy - _median(xy), axis=2)
    same = off < 0.5 * _COINCIDE * float(view.size.max())
    count = same.sum(axis=0)
    if count.max() < 2:
        return None
    spread = np.where(count == count.max(), np.where(same, off, 0.0).max(axis=0), -1.0)
    place = int(np.argmax(spread))
    centre = xy[same[:, place], place].mean(axis=0)
    half = max(1.8 * float(spread[place]), _LEAST_ZOOM * float(view.size.max()))
    return View(centre - half, centre + half)


def _at(track: PathFromAbove, at_ns: IntArray) -> Array:
    """Return the positions (K, 2) at stamps, between those of a track; NaN outside."""
    given = [np.interp(at_ns, track.t_ns, component, left=np.nan, right=np.nan) for component in track.xy.T]
    return np.stack(given, axis=1)


def _median(xy: Array) -> Array:
    """Return the median (K, 2) over tracks (T, K, 2) of those that are there; zero where none is."""
    there = np.isfinite(xy)
    low_first = np.sort(np.where(there, xy, np.inf), axis=0)
    middle = (np.maximum(there.sum(axis=0), 1) - 1) // 2
    median = np.take_along_axis(low_first, middle[None], axis=0)[0]
    return np.where(np.isfinite(median), median, 0.0)
