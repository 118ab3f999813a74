"""What is said about many seeds: spreads over the runs that are ok, the NEES of all against the band of as many."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from toolkit.experiment.comparison import Comparison, in_order
from toolkit.experiment.statistics import mean_nees, quantiles_of_all, ratio_of_means
from toolkit.experiment.units import Outcome
from toolkit.files.documents import parse, to_text
from toolkit.metrics import Scores, describe
from toolkit.metrics.parts.consistency import nees_band
from toolkit.report.comparison_table import comparison_text, report_text
from toolkit.report.messages import note_lines
from toolkit.report.scores import Seeds, seeds_document

Document = dict[str, Any]


@pytest.mark.parametrize("seeds", [1, 5, 40])
def test_the_mean_nees_of_consistent_runs_is_in_its_band_at_95_percent(seeds):
    frames = 20_000
    nees = np.random.default_rng(7).chisquare(6, (seeds, frames)) / 6
    assert mean_nees(nees).in_band_percent == pytest.approx(95.0, abs=4.0 * 100.0 * np.sqrt(0.95 * 0.05 / frames))


def test_the_band_is_for_the_runs_that_are_there():
    nees = np.ones((3, 4))
    nees[0, 1:] = nees[1, 2:] = nees[2, 3:] = np.nan
    averaged = mean_nees(nees)
    assert averaged.runs.tolist() == [3, 2, 1, 0]
    assert (averaged.low[0], averaged.high[0]) == nees_band(6, 3)
    assert (averaged.low[2], averaged.high[2]) == nees_band(6, 1)
    assert np.isnan(averaged.mean[3])
    assert averaged.in_band_percent == 100.0


def test_a_seed_that_diverged_is_counted_and_in_no_mean_and_who_never_answers_keeps_a_line(over):
    rows = [("honest", "causal"), ("honest", "final"), ("astray", "causal"), ("broken", "final")]
    assert [(row.estimator, row.output) for row in over.rows] == rows
    astray, broken = over.rows[2:]
    assert astray.counts == {"ok": 3, "diverged": 1, "failed": 0}
    assert astray.spread("ate_none_m").mean == pytest.approx((3.0 + 5.0 + 6.0) / 3)
    assert astray.values("ate_none_m") == [3.0, 4.0, 5.0, 6.0]
    assert (broken.spread("ate_none_m"), broken.reason("ate_none_m")) == (None, "no run is ok")
    assert not over.all_ok


def test_a_bad_run_spoils_the_quartiles_it_reaches():
    one = quantiles_of_all([1.0, 2.0, 3.0, 4.0], 1, "least")
    assert (one.lower_quartile, one.median, one.upper_quartile) == (2.0, 3.0, 4.0)
    half = quantiles_of_all([1.0, 2.0, 3.0], 3, "one")
    assert (half.lower_quartile, half.median, half.upper_quartile) == (2.25, None, None)
    assert half.reason == "3 of 6 runs did not end well, and each counts as infinitely bad"
    least = quantiles_of_all([90.0, 95.0, 100.0], 1, "most")  # of a share, the bad run's is the lowest
    assert (least.lower_quartile, least.median, least.upper_quartile) == (None, 92.5, 96.25)
    assert quantiles_of_all([1.0], 1, "") is quantiles_of_all([], 0, "least") is None


def test_runs_that_ended_badly_are_reported_beside_the_means(over, document):
    astray, broken = (document["runs"][i] for i in (2, 3))
    assert (astray["ok_share"], broken["ok_share"]) == (0.75, 0.0)
    # Under the seeds 3, 5 and 6 its ATE is 3, 5 and 6 m; seed 4 diverged.
    quartiles = astray["metrics"]["ate_none_m"]["quantiles_all"]
    assert {name: quartiles[name] for name in ("lower_quartile", "median")} == {"lower_quartile": 4.5, "median": 5.5}
    assert quartiles["upper_quartile"] is None
    assert quartiles["reason"] == "1 of 4 runs did not end well, and each counts as infinitely bad"
    assert "quantiles_all" not in astray["metrics"]["ate_se3_m"]  # its sound runs have none
    assert broken["metrics"]["ate_none_m"]["quantiles_all"]["median"] is None
    words = "\n".join(note_lines(over))
    assert "honest final 4.50 m (100 % ok); astray causal 5.50 m (75 % ok); broken final none, 4 of 4 runs" in words


def _with_values(outcome: Outcome, values: dict[str, float | None]) -> Outcome:
    scored = outcome.outputs["causal"]
    scores = Scores(scored.scores.values | values, scored.scores.notes)
    return replace(outcome, outputs={"causal": replace(scored, scores=scores)})


@pytest.fixture
def document(over: Comparison) -> Document:
    read: Document = json.loads(to_text(seeds_document(over)))
    return read


def test_seeds_json_obeys_its_contract(over, document):
    assert parse(to_text(seeds_document(over)), Seeds) == seeds_document(over)
    assert list(document["runs"][0]["metrics"]) == list(describe())
    assert document["runs"][2]["status"] == ["ok", "diverged", "ok", "ok"]
    assert document["runs"][0]["over_seeds"]["nees_pose_band"] == list(nees_band(6, 4))
    assert document["hashes"] == ["hash3", "hash4", "hash5", "hash6"]


def test_the_report_names_what_went_wrong_and_who_is_too_sure(over):
    for text in (comparison_text(over), report_text(over, {})):
        assert "astray diverged under seed 4: left the road" in text
        assert "broken failed under seeds 3, 4, 5 and 6: failed after 0 estimates: no gauge" in text
        assert "overconfident" in " ".join(text.split())
    assert max(map(len, comparison_text(over).splitlines())) <= 100


def test_the_stated_share_of_the_true_variance_is_a_ratio_of_means_with_its_error(over):
    honest = over.rows[0].outcomes
    claims, excesses = (1.2, 1.0, 1.1, 1.1), (0.1, 0.3, -0.1, 0.1)
    reported = [
        _with_values(one, {"claimed_variance": claim, "excess_variance": excess})
        for one, claim, excess in zip(honest, claims, excesses, strict=True)
    ]
    known = replace(over, outcomes=in_order((*reported, *over.rows[2].outcomes), ("honest", "astray"), over.seeds))
    assert "it states 1.00 ± 0.10 of its true variance" in " ".join(report_text(known, {}).split())
    ratio = ratio_of_means((1.2, 1.0, 1.1, 1.1), (1.1, 1.3, 0.9, 1.1))
    assert ratio is not None and ratio.mean == pytest.approx(1.0)
    assert ratio.error == pytest.approx(math.sqrt((0.1**2 + 0.3**2 + 0.2**2) / 3 / 4) / 1.1)


def test_the_error_of_a_ratio_of_means_is_that_of_repeating_the_experiment():
    rng = np.random.default_rng(6)
    below = rng.uniform(0.5, 1.5, (4000, 20))
    above = 2.0 * below + rng.normal(scale=0.3, size=below.shape)
    found = [ratio_of_means(a, b) for a, b in zip(above.tolist(), below.tolist(), strict=True)]
    values, errors = np.array([(one.mean, one.error) for one in found if one is not None]).T
    assert values.mean() == pytest.approx(2.0, abs=0.005)  # its standard error is 0.001
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(values.std(), rel=0.05)
    assert ratio_of_means([1.0, None], [None, 1.0]) is None
