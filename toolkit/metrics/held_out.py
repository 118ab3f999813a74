"""Held-out reprojection: tracks no estimator is given, each sighting predicted from the others of its track.

Needs no ground truth, and overfitting does not lower it: the points come from the estimated poses alone.
"""

from toolkit.geometry import Array
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.leave_one_out import FEWEST_VIEWS
from toolkit.metrics.parts.residuals import pixel_metrics, pixel_scores
from toolkit.metrics.parts.scores import Scores, Unavailable

ORDER = 60
METRICS = pixel_metrics(
    "heldout_reproj",
    "leave-one-view-out reprojection error of the one track in ten no estimator is given",
    "held-out",
    ("held-", "out"),
    table="always",
    over_seeds=True,
    gate_name="held-out reprojection",
)


def score(evaluation: Evaluation) -> Scores:
    """Score how well the evaluated poses predict the withheld tracks."""
    lacking = f"belong to frames without a pose or to tracks with fewer than {FEWEST_VIEWS} posed views"
    return pixel_scores("heldout_reproj", errors(evaluation), len(evaluation.sequence.held_out), lacking)


def errors(evaluation: Evaluation) -> Array:
    """Return the leave-one-view-out error (N,) px of every sighting of a withheld track with enough posed views."""
    _, errors_px = evaluation.held_out_errors
    if not errors_px.size:
        raise Unavailable(f"no withheld track has {FEWEST_VIEWS} views from frames with a pose")
    return errors_px
