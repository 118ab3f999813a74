"""Who is marked overconfident or timid: those off by more than a consistent estimator's run can be, and no others."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.datasets import load_sequence
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Row, consistency_of
from toolkit.experiment.units import Scored, outcome_of
from toolkit.metrics import Evaluation, Scores
from toolkit.metrics.parts.consistency import Nis, nees_band, nis_over_time
from toolkit.models.gating import mean_below_bound

NOTHING = np.empty(0)


@pytest.fixture
def make_evaluation() -> Callable[..., Evaluation]:
    """Return a function that makes an evaluation whose run reports innovations of some freedom in every frame."""

    def make(frames: int, dof: float) -> Evaluation:
        sequence = load_sequence("drive").truncated(frames)
        reported = Trajectory(sequence.frames_t_ns, np.tile(np.eye(4), (frames, 1, 1)))
        info = {"nis": np.full(frames, dof), "nis_dof": np.full(frames, dof)}
        return Evaluation(Run("made-up", "ok", reported, reported, Landmarks.none(), None, info), "causal", sequence)

    return make


def run_of(nees: float | None = None, nis: float | None = None, dof: float | None = None, **values: float) -> Scored:
    return Scored(Scores({"nees_pose_mean": nees, "nis_mean": nis, **values}), NOTHING, NOTHING, dof)


def leaning(trend: float, **values: float) -> Scored:
    """Return a run whose corrections have a trend, with a limit of 4."""
    scores = Scores({"correction_trend": trend, "correction_trend_limit": 4.0, **values})
    return Scored(scores, NOTHING, NOTHING, 900.0)


def verdict(*runs: Scored) -> str | None:
    found = consistency_of(runs)
    return None if found is None else found.verdict


VERDICTS = [
    # A textbook's quantiles of six degrees of freedom, 1.237 and 14.449, over 6: 0.206 and 2.408.
    *(([run_of(nees)], "consistent") for nees in (0.22, 1.0, 2.3)),
    ([run_of(0.19)], "timid"),
    ([run_of(2.5)], "overconfident"),
    # Many seeds see what one cannot.
    ([run_of(1.5)] * 20, "overconfident"),
    ([run_of(0.6)] * 20, "timid"),
    ([run_of(1.1)] * 20, "consistent"),
    # The errors decide where there are any, and else the innovations.
    ([run_of(nees=1.0, nis=1.5, dof=900.0)], "consistent"),
    ([run_of(nis=1.5, dof=900.0)], "overconfident"),
    ([run_of(nis=0.8, dof=900.0)], "timid"),
    ([run_of(nis=1.05, dof=900.0)], "consistent"),
    ([run_of(nis=1.5, dof=6.0)], "consistent"),
    # Small innovations behind a gate that refused many are no timid estimator's.
    ([run_of(nis=0.4, dof=900.0, gate_accepted_percent=95.0)], "timid"),
    ([run_of(nis=0.4, dof=900.0, gate_accepted_percent=88.0)], "heavy-tailed"),
    ([run_of()], None),
    # Corrections that lean one way are reported, unless errors tell of too much certainty; over seeds by their mean.
    ([leaning(5.1)], "contradicted"),
    ([leaning(5.1, nees_pose_mean=1.0)], "contradicted"),
    ([leaning(5.1, nis_mean=0.5)], "contradicted"),
    ([leaning(5.1, nees_pose_mean=3.0)], "overconfident"),
    ([leaning(3.9, nis_mean=0.5)], "timid"),
    ([leaning(3.9)], None),
    ([leaning(5.0), leaning(2.0)], None),
    ([leaning(7.0), leaning(2.0)], "contradicted"),
]


@pytest.mark.parametrize(("runs", "expected"), VERDICTS)
def test_who_is_marked_and_as_what(runs, expected):
    assert verdict(*runs) == expected


@pytest.mark.parametrize("alike", [1, 10, 100])
def test_five_percent_of_consistent_runs_are_marked_at_most_however_long_their_errors_last(alike):
    """Errors of 100 poses that change every 1, 10 or 100 poses, drawn from the covariance that is stated."""
    drawn = np.random.default_rng(alike).chisquare(6, (4000, 100 // alike)) / 6.0
    marked = np.mean([verdict(run_of(float(run.mean()))) != "consistent" for run in drawn])
    assert marked <= 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / 4000)  # four standard errors of the share


def test_innovations_that_share_one_error_count_once_a_frame(make_evaluation):
    """100 frames of 30 sightings each whose NIS is that of one: the mean scatters as 300 degrees of freedom say."""
    one = np.random.default_rng(5).chisquare(3, (2000, 100))
    means, dof = (30.0 * one).sum(axis=1) / (90.0 * 100), nis_over_time(make_evaluation(100, dof=90.0)).independent_dof
    assert dof == pytest.approx(300.0)
    assert means.var() == pytest.approx(2.0 / dof, rel=0.15)  # the variance of 2000 draws scatters by 3 %
    assert nis_over_time(make_evaluation(100, dof=2.0)).independent_dof == pytest.approx(200.0)


def share_above_and_below(nis: np.ndarray, dof: float, expected: float) -> np.ndarray:
    """Return the shares of frames (2,) above and below the band of each of the runs (runs, frames), on average."""
    shares = []
    for run in nis:
        of_run = Nis(np.arange(run.size), run, np.full(run.size, dof), np.full(run.size, expected))
        low, high = of_run.bands()
        shares.append([np.mean(run / expected > high), np.mean(run / expected < low)])
    return np.mean(shares, axis=0)


def test_the_band_of_a_frame_holds_95_percent_behind_a_gate_and_where_frames_share_an_error():
    """100 runs of 100 frames of 60 sightings: the share in the band is known to 0.3 %, the band itself scatters."""
    rng = np.random.default_rng(6)
    sightings = rng.chisquare(3, (100, 100, 60))
    alone, gated = sightings.sum(axis=2), np.where(sightings < 7.815, sightings, 0.0).sum(axis=2)
    expected = 60 * 0.95 * float(mean_below_bound(3, 0.95))
    shared = alone + 20.0 * (rng.chisquare(1, (100, 100)) - 1.0)  # 2.1 times the variance
    for nis, mean in ((alone, 180.0), (gated, expected), (shared, 180.0)):
        above, below = share_above_and_below(nis, 180.0, mean)
        assert 0.03 < above + below < 0.08
    plain = nees_band(180.0)
    assert np.mean((shared / 180.0 < plain[0]) | (shared / 180.0 > plain[1])) > 0.1
    assert share_above_and_below(1.5 * alone, 180.0, 180.0)[0] > 0.75
    assert share_above_and_below(alone[:, :10], 180.0, 180.0).sum() == pytest.approx(0.05, abs=0.02)  # chi-square's


def test_without_truth_innovations_mark_a_filter_that_is_given_half_the_noise(run_estimator):
    sequence = replace(load_sequence("drive", seed=1).truncated(60), truth=None)
    rig = replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 / 4.0)
    for name, wanted, expected in (("sound", sequence, ""), ("told", replace(sequence, rig=rig), "overconfident")):
        outcome = outcome_of(run_estimator("msckf-fej", wanted), wanted, 1)
        assert Row("causal", (outcome,)).mark == expected, name
