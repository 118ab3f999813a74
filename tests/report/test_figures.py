"""Figures show the data: the same colours everywhere, equal scale from above, no point squashing the rest."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import about_z, se3
from toolkit.report.curves import error_curves, errors_to, onto_truth, truth_during
from toolkit.report.figures import against_bound, errors_over_time, frame_times, reprojection, top_view
from toolkit.report.figures.style import colour_of, width_of
from toolkit.settings import Metrics, Settings
from toolkit.simulation import DRIVE, simulate

ComparisonOf = Callable[..., Comparison]


def map_of(figure: Figure) -> Axes:
    """Return the axes that have a map in them, of a figure with its legend in other axes."""
    return next(axes for axes in figure.axes if axes.get_xlabel() == "x [m]")


def test_top_view_has_equal_scale_and_a_figure_an_estimator(comparison: Comparison) -> None:
    drawn = {name: figure for name, _, figure in (*top_view.draw_all(comparison), *top_view.draw_each(comparison))}
    assert list(drawn) == ["top_all", "top_steady", "top_astray", "top_late"]
    for figure in drawn.values():
        assert map_of(figure).get_aspect() == 1.0
        assert "[m]" in map_of(figure).get_xlabel()


def test_far_landmarks_do_not_squash_the_top_view(comparison: Comparison, comparison_of: ComparisonOf) -> None:
    late = comparison.runs[2]
    points = late.landmarks.points_world.copy()
    points[:10] = 1e6
    spoiled = replace(late, landmarks=Landmarks(late.landmarks.track_ids, points))
    ((_, _, figure),) = top_view.draw_all(comparison_of(comparison.sequence, (spoiled,)))
    low, high = map_of(figure).get_xlim()
    assert high - low < 500.0


def test_every_estimator_has_its_own_colour(comparison: Comparison) -> None:
    colours = [colour_of(comparison, run.estimator) for run in comparison.runs]
    assert len(set(colours)) == len(colours)


def test_aligned_errors_vanish_where_only_yaw_and_position_differ(comparison: Comparison) -> None:
    sequence, late = comparison.sequence, comparison.runs[2]
    truth = truth_during(sequence)
    assert truth is not None
    moved = se3(about_z(1.2), np.array([5.0, -3.0, 1.0])) @ truth.T_world_imu
    run = replace(late, final=replace(late.final, t_ns=truth.t_ns, T_world_imu=moved))
    errors = errors_to(truth, run.final, onto_truth(run, "final", sequence), sequence)
    assert errors is not None
    # Positions of 100 m and a fitted angle: some 1e-16 relative of each.
    assert errors.position_m.max() < 1e-10
    assert np.abs(errors.heading_deg).max() < 1e-9


def test_equal_lines_do_not_hide_each_other(comparison: Comparison) -> None:
    widths = [width_of(comparison, run.estimator) for run in comparison.runs]
    assert all(above < below for below, above in itertools.pairwise(widths))


def test_estimators_that_agree_to_rounding_look_so(without_truth: Comparison, comparison_of: ComparisonOf) -> None:
    late = without_truth.runs[1]
    assert late.final is not None
    rounded = replace(late.final, T_world_imu=late.final.T_world_imu * (1.0 + 1e-15))
    twins = (replace(late, estimator="twin", final=rounded), late)
    (drawn,) = errors_over_time.draw(comparison_of(without_truth.sequence, twins))
    position, heading = drawn.figure.axes
    assert position.get_ylim()[1] >= 1e-3
    assert heading.get_ylim()[1] >= 1e-2


def test_one_slow_step_at_the_end_does_not_bend_the_running_median(
    comparison: Comparison, comparison_of: ComparisonOf
) -> None:
    steady = comparison.runs[0]
    step_s = np.full(steady.timings.step_s.size, 1e-3)
    step_s[[0, -1]] = 1.0
    slow = replace(steady, timings=replace(steady.timings, step_s=step_s))
    (drawn,) = frame_times.draw(comparison_of(comparison.sequence, (slow,)))
    dots, median = drawn.figure.axes[0].get_lines()
    assert np.max(dots.get_ydata()) == pytest.approx(1e3)
    assert np.max(median.get_ydata()) == pytest.approx(1.0)


def test_without_truth_the_figure_says_it_shows_differences(without_truth: Comparison) -> None:
    (drawn,) = errors_over_time.draw(without_truth)
    assert "no truth" in drawn.caption
    assert "difference from late final" in drawn.figure.axes[0].get_title(loc="left")


def test_a_diverged_run_does_not_flatten_the_others(comparison: Comparison) -> None:
    (drawn,) = errors_over_time.draw(comparison)
    curves = error_curves(comparison)
    assert curves is not None
    good_m = max(errors.position_m.max() for row, errors in curves.of_rows if row.status == "ok")
    position, _ = drawn.figure.axes
    assert position.get_ylim()[1] < 2.0 * good_m
    assert "astray" in position.get_title(loc="right")


def test_a_heading_far_from_the_others_leaves_its_panel_and_is_named(
    comparison: Comparison, comparison_of: ComparisonOf
) -> None:
    runs = [run for run in comparison.runs if run.status == "ok"]
    turned = replace(runs[0], estimator="turned", final=None, causal=turning(runs[0].trajectory("causal"), 30.0))
    (drawn,) = errors_over_time.draw(comparison_of(comparison.sequence, (*runs, turned)))
    heading = drawn.figure.axes[1]
    assert heading.get_ylim()[1] < 15.0
    assert "turned" in heading.get_title(loc="right")


def turning(trajectory: Trajectory | None, most_deg: float) -> Trajectory:
    """Return a trajectory whose heading leaves the one given ever more."""
    assert trajectory is not None
    angles = np.radians(np.linspace(0.0, most_deg, trajectory.t_ns.size))
    poses = trajectory.T_world_imu.copy()
    poses[:, :3, :3] = np.stack([about_z(float(angle)) for angle in angles]) @ poses[:, :3, :3]
    return replace(trajectory, T_world_imu=poses)


@pytest.mark.parametrize("draw", [reprojection.draw, frame_times.draw, errors_over_time.draw, top_view.draw_all])
def test_a_comparison_of_failures_draws_nothing(comparison: Comparison, draw: object) -> None:
    broken = replace(comparison, outcomes=comparison.outcomes[3:])
    assert callable(draw)
    assert list(draw(broken)) == []


def test_the_bound_is_drawn_where_it_was_requested(comparison_of: ComparisonOf, run_estimator) -> None:
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    usual = comparison_of(sequence, tuple(run_estimator(name, sequence) for name in ("dead-reckoning", "ekf")))
    assert list(against_bound.draw(usual)) == []
    requested = replace(usual, settings=Settings(metrics=Metrics(bound=True)))
    (drawn,) = against_bound.draw(requested)
    position = drawn.figure.axes[0]
    lines = {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in position.get_lines()}
    assert "thin: stated" in [text.get_text() for text in drawn.figure.legends[0].get_texts()]
    # Dead reckoning knows less than the bound's measurements tell, so it errs beyond it; both begin with the prior.
    assert lines["dead-reckoning both"][-1] > position.get_ylim()[0]
    assert lines["bound causal"][0] == pytest.approx(np.sqrt(np.trace(sequence.prior.cov[3:6, 3:6])), rel=1e-6)


def test_a_recording_without_a_bound_has_no_such_figure(without_truth: Comparison) -> None:
    requested = replace(without_truth, settings=Settings(metrics=Metrics(bound=True)))
    assert list(against_bound.draw(requested)) == []
