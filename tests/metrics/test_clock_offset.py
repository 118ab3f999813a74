"""Properties of the clock offset: it is found, known as well as it says, and not made up where nothing tells it."""

import numpy as np
import pytest

from toolkit.geometry import Array, se3, se3_exp
from toolkit.metrics import clock_offset
from toolkit.metrics.parts.evaluation import Matched, PairsAgainstTruth, distance_along
from toolkit.metrics.parts.scores import Scores

PERIOD_S = 0.1
ELSEWHERE = se3_exp(np.array([0.4, -0.2, 1.9, 30.0, -4.0, 2.0]))


def path(t_s: Array) -> Array:
    """Return positions (n, 3) m of a vehicle that circles at a changing speed, and bobs."""
    angle = 0.5 * t_s + 0.4 * np.sin(0.7 * t_s)
    return np.stack([4.0 * np.cos(angle), 4.0 * np.sin(angle), 0.5 * np.sin(1.3 * t_s)], axis=1)


def scored(late_s: float = 0.0, sigma_m: float = 0.0, seed: int = 0, kept: object = slice(None)) -> Scores:
    """Score an estimate in a world of its own whose stamps are late, with white noise, on some of 300 stamps."""
    t_s = PERIOD_S * np.arange(300)[kept]
    noise = np.random.default_rng(seed).normal(0.0, sigma_m, (len(t_s), 3))
    return compared(t_s, path(t_s), path(t_s - late_s) + noise)


def compared(t_s: Array, true: Array, estimated: Array) -> Scores:
    """Score estimated positions (n, 3), moved to another world, against true ones."""
    turned, upright = np.broadcast_to(np.eye(3), (len(t_s), 3, 3)), ELSEWHERE @ se3(np.eye(3), estimated)
    pairs = Matched(np.round(1e9 * t_s).astype(np.int64), se3(turned, true), upright, distance_along(true))
    return clock_offset.score(PairsAgainstTruth(pairs))


@pytest.mark.parametrize("late_s", [-0.35, 0.004])
def test_late_stamps_are_found_and_reported_with_what_mending_them_is_worth(late_s: float) -> None:
    scores = scored(late_s, sigma_m=1e-4)
    assert scores.values["clock_offset_ms"] == pytest.approx(-1e3 * late_s, abs=0.05)  # five of its standard errors
    assert f"shifted by {-1e3 * late_s:.1f} +- 0.0 ms" in scores.notes["clock_offset_ms"]
    left_m = float(scores.notes["clock_offset_ms"].split("to ")[1].split(" m")[0])
    assert left_m == pytest.approx(3.0**0.5 * 1e-4, rel=0.1)  # the noise, over three axes


def test_the_standard_error_is_that_of_many_draws_and_equal_clocks_are_not_remarked_on() -> None:
    draws = [scored(sigma_m=0.02, seed=seed) for seed in range(30)]
    offsets = np.array([draw.values["clock_offset_ms"] for draw in draws])
    errors = np.array([draw.values["clock_offset_error_ms"] for draw in draws])
    # A standard deviation of thirty draws is known to an eighth, three of which are allowed for.
    assert np.sqrt(np.mean(offsets**2)) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.4)
    assert not any(draw.notes for draw in draws)


def test_a_truth_across_a_gap_is_not_made_up() -> None:
    kept = np.r_[0:120, 180:300]
    assert scored(0.02, kept=kept).values["clock_offset_ms"] == pytest.approx(-20.0, abs=0.01)


def test_steady_motion_along_a_line_and_few_pairs_leave_it_open() -> None:
    t_s = PERIOD_S * np.arange(100)
    line = t_s[:, None] * np.array([3.0, 1.0, 0.0])
    scores = compared(t_s, line, line)
    assert scores.values["clock_offset_ms"] is None
    assert "the velocity hardly changes" in scores.notes["clock_offset_ms"]
    assert "needs 30 matched pairs" in scored(kept=slice(0, 20)).notes["clock_offset_ms"]


@pytest.mark.parametrize("since_first", [0.0, 0.5])
@pytest.mark.parametrize("rate", [0.93, 1.005])
def test_a_clock_that_runs_fast_or_slow_is_reported_with_its_rate(rate: float, since_first: float) -> None:
    """Stamps that run fast are those of an earlier place: the estimate is where it was at the time by a right clock."""
    t_s = PERIOD_S * np.arange(300)
    origin_s = since_first * t_s[-1]
    scores = compared(t_s, path(t_s), path(origin_s + (t_s - origin_s) / rate))
    reported = scores.notes["clock_offset_ms"]
    assert reported.startswith("time passes ")
    assert float(reported.split()[2]) == pytest.approx(rate, abs=1e-4)


def drifting(t_s: Array) -> Array:
    """Return positions that drift from the path, with noise."""
    rng = np.random.default_rng(0)
    return path(t_s) + np.cumsum(rng.normal(0.0, 0.01, (len(t_s), 3)), axis=0) + rng.normal(0.0, 0.02, (len(t_s), 3))


@pytest.mark.parametrize(
    "estimated",
    [
        drifting,
        *(lambda t_s, scale=scale: scale * path(t_s) for scale in (0.9, 3.28)),
        *(lambda t_s, late_s=late_s: path(t_s - late_s) for late_s in (4.0, 9.0, 15.0)),
    ],
)
def test_a_drift_another_scale_and_another_stretch_of_the_path_are_no_rate_of_a_clock(estimated) -> None:
    t_s = PERIOD_S * np.arange(150)
    assert "time passes" not in compared(t_s, path(t_s), estimated(t_s)).notes.get("clock_offset_ms", "")
