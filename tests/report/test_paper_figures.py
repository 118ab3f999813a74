"""Figures fit for a paper: errors by component, consistency with its band, maps coloured by error, a closer look."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.inset import InsetIndicator

from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import about_z, interpolate_poses, se3
from toolkit.metrics import Evaluation, Scores, reprojection
from toolkit.report import figures
from toolkit.report.curves import Components
from toolkit.report.figures import FigureChoice, consistency, drawn, error_map, errors_over_time, panels, top_view
from toolkit.report.figures.style import NamedFigure
from toolkit.report.figures.top_view import NOWHERE, PathFromAbove, View, view_of, where_tracks_coincide
from toolkit.sequence import Sequence

ComparisonOf = Callable[..., Comparison]
Draw = Callable[[Comparison], Iterator[NamedFigure]]
CHOICES: tuple[FigureChoice, ...] = ("few", "all", "none")

OFFSET_M = np.array([0.3, -0.2, 0.1])
SIGMA_DEG, SIGMA_M = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.4])


@pytest.fixture(scope="module")
def offset(sequence: Sequence, comparison: Comparison, comparison_of: ComparisonOf) -> Comparison:
    """The truth with every pose set off along its own axes and turned about its vertical, with stated covariances."""
    truth, t_ns = sequence.truth, sequence.frames_t_ns
    assert truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns)
    wrong = poses @ se3(about_z(np.radians(0.5)), OFFSET_M)
    cov = np.tile(np.diag(np.concatenate([np.radians(SIGMA_DEG), SIGMA_M]) ** 2), (t_ns.size, 1, 1))
    trajectory = Trajectory(t_ns, wrong, cov=cov)
    steady = comparison.runs[0]
    run = replace(steady, estimator="offset", causal=trajectory, final=trajectory)
    return comparison_of(sequence, (run, steady))


@pytest.fixture(scope="module")
def fourteen(comparison: Comparison) -> Comparison:
    """One run under fourteen names; it need not be scored so many times."""
    one = comparison.outcomes[0]
    names = [f"estimator-{n}" for n in range(14)]
    again = (replace(one, estimator=name, run=replace(comparison.runs[0], estimator=name)) for name in names)
    return replace(comparison, outcomes=tuple(again))


def of_offset(offset: Comparison) -> Components:
    (row,) = (row for row in offset.lines if row.estimator == "offset")
    found = errors_over_time.components(offset, row)
    assert found is not None
    return found


def test_components_are_estimate_minus_truth_in_the_worlds_axes(offset: Comparison, sequence: Sequence) -> None:
    found, truth = of_offset(offset), sequence.truth
    assert truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, found.t_ns)
    # Positions of 100 m: some 1e-16 of that.
    np.testing.assert_allclose(found.error[:, 3:], poses[:, :3, :3] @ OFFSET_M, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.error[:, :3], axis=1), 0.5, atol=1e-10)


def test_stated_deviations_turn_with_the_body(offset: Comparison, sequence: Sequence) -> None:
    found, truth = of_offset(offset), sequence.truth
    assert truth is not None
    assert found.sigma is not None
    estimate = offset.runs[0].final
    assert estimate is not None
    turn = estimate.T_world_imu[:, :3, :3]
    np.testing.assert_allclose(found.sigma[:, 3:] ** 2, (turn**2) @ SIGMA_M**2, rtol=1e-9)
    np.testing.assert_allclose((found.sigma[:, :3] ** 2).sum(axis=1), (SIGMA_DEG**2).sum(), rtol=1e-9)


def all_components(comparison: Comparison) -> list[NamedFigure]:
    telling = errors_over_time.draw_telling_components(comparison)
    return [*telling, *errors_over_time.draw_other_components(comparison)]


def test_the_least_and_the_most_consistent_estimator_are_drawn_by_component_first(
    comparison: Comparison, rescored: Callable[..., Comparison]
) -> None:
    nees = {"steady": 0.01, "astray": 5.0, "late": 1.1}
    scored = rescored(
        comparison, lambda row: Scores(row.scores.values | {"nees_pose_mean": nees.get(row.estimator)}, {})
    )
    names = [figure.name for figure in all_components(scored)]
    assert names[:2] == ["components_steady", "components_late"]
    assert len({*names}) == len(names)


def test_the_band_is_three_deviations_and_all_of_the_error_is_shown(offset: Comparison) -> None:
    one = next(figure for figure in all_components(offset) if figure.name == "components_offset")
    found, axes = of_offset(offset), one.figure.axes[0]
    assert found.sigma is not None
    lower, upper, error = (np.asarray(line.get_ydata()) for line in axes.get_lines()[:3])
    np.testing.assert_allclose(upper, 3.0 * found.sigma[:, 3])
    np.testing.assert_allclose(lower, -upper)
    np.testing.assert_allclose(error, found.error[:, 3])
    assert axes.get_ylim()[1] > np.abs(error).max()


def test_without_truth_components_are_differences_from_the_last_answer(without_truth: Comparison) -> None:
    (one,) = all_components(without_truth)
    assert one.name == "components_steady"
    assert "no truth" in one.caption
    assert "late final" in one.caption


def test_the_share_in_the_band_is_the_metrics(offset: Comparison) -> None:
    (one,) = consistency.draw_nees(offset)
    (row,) = (row for row in offset.lines if row.estimator == "offset")
    share = row.value("nees_pose_in_band_percent")
    assert share is not None
    assert one.figure.axes[0].get_title(loc="right") == f"{share:.0f} % in band"


def test_a_panel_whose_values_leave_the_figure_says_how_large_they_become() -> None:
    t_s, ones = np.arange(4.0), np.ones(4)
    inside = panels.Normalised(t_s, np.array([1.0, 9e3, 1.0, np.nan]), 0.5 * ones, 2.0 * ones)
    beyond = inside._replace(value=np.array([1.0, 1.0, 7.2e5, np.nan]))
    drawn = [panels.Drawn(name, "#000000", "final", series) for name, series in (("in", inside), ("out", beyond))]
    figure = panels.figure_with_bands(["in", "out"], drawn, "NEES", "a drive")
    assert [axes.get_title(loc="right") for axes in figure.axes] == ["67 % in band", "67 % in band, up to 7e+05"]


def test_without_truth_there_is_no_nees_and_without_innovations_no_nis(without_truth: Comparison) -> None:
    assert list(consistency.draw_nees(without_truth)) == []
    assert list(consistency.draw_nis(without_truth)) == []


def test_landmarks_have_the_error_of_their_sightings(comparison: Comparison) -> None:
    evaluation = Evaluation(comparison.runs[0], "final", comparison.sequence)
    ids, error_px = reprojection.errors_of_landmarks(evaluation)
    one = ids[ids.size // 2]
    kept = evaluation.run.landmarks.track_ids == one
    landmarks = evaluation.run.landmarks
    alone = replace(landmarks, track_ids=landmarks.track_ids[kept], points_world=landmarks.points_world[kept], cov=None)
    of_one = reprojection.in_sample_errors(replace(evaluation, run=replace(evaluation.run, landmarks=alone)))
    assert error_px[ids == one] == pytest.approx(np.sqrt(np.mean(of_one**2)))


def test_all_panels_of_a_map_share_a_scale_of_colours(comparison: Comparison) -> None:
    (one,) = error_map.draw_trajectories(comparison)
    titles = [axes.get_title(loc="left") for axes in one.figure.axes]
    assert titles[:3] == ["steady", "astray (diverged)", "late"]
    assert one.figure.axes[3].get_ylabel() == "position error [m]"
    assert list(error_map.draw_trajectories(replace(comparison, outcomes=comparison.outcomes[3:]))) == []


def straight(offset_m: float, widening_m: float = 0.0) -> PathFromAbove:
    t_ns = np.arange(101)
    return PathFromAbove(t_ns, np.stack([t_ns.astype(float), offset_m + widening_m * t_ns / 100.0], axis=1))


def test_the_closer_look_is_where_lines_that_look_like_one_differ_most() -> None:
    view = View(np.array([0.0, -50.0]), np.array([100.0, 50.0]))
    tracks = [straight(0.0), straight(0.01, widening_m=0.5), straight(30.0)]
    closer = where_tracks_coincide(tracks, view, np.arange(101))
    assert closer is not None
    # At the end of the two; the third is far from both and not in it.
    assert closer.low[0] < 100.0 < closer.high[0]
    assert closer.low[1] < 0.0
    assert 0.51 < closer.high[1] < 2.0


@pytest.mark.parametrize("turn_rad", [-0.5, 1.0])
def test_lines_to_the_closer_look_end_at_the_corners_that_face_the_map(
    sequence: Sequence, comparison: Comparison, comparison_of: ComparisonOf, turn_rad: float
) -> None:
    truth = sequence.truth
    assert truth is not None
    turned = replace(truth, T_world_imu=se3(about_z(turn_rad), np.zeros(3)) @ truth.T_world_imu)
    (one,) = top_view.draw_all(comparison_of(replace(sequence, truth=turned), comparison.runs))
    FigureCanvasAgg(one.figure).draw()
    _, the_map, panel = one.figure.axes
    (square,) = (artist for artist in the_map.get_children() if isinstance(artist, InsetIndicator))
    lines = [line for line in square.connectors or () if line.get_visible()]
    ends = np.array([line.get_path().vertices[0] for line in lines])
    box = panel.get_window_extent()
    beside = box.y1 > the_map.get_window_extent().y0
    assert beside == (turn_rad > 0.0)
    facing = [(box.x0, box.y0), (box.x0, box.y1)] if beside else [(box.x0, box.y1), (box.x1, box.y1)]
    np.testing.assert_allclose(ends, facing, atol=0.5)
    # A panel takes the place that its equal scale leaves it when it is drawn: before the lines to it.
    assert panel.get_zorder() < the_map.get_zorder()


def test_a_run_without_poses_is_no_line_and_widens_no_view() -> None:
    nowhere = PathFromAbove(np.empty(0, np.int64), np.empty((0, 2)))
    (both, one) = (view_of(tracks, NOWHERE) for tracks in ([straight(0.0), nowhere], [straight(0.0)]))
    np.testing.assert_array_equal(both, one)
    assert np.isfinite(view_of([nowhere], NOWHERE)).all()


def test_lines_that_are_apart_need_no_closer_look() -> None:
    view = View(np.array([0.0, -50.0]), np.array([100.0, 50.0]))
    assert where_tracks_coincide([straight(0.0), straight(20.0)], view, np.arange(101)) is None
    nowhere = PathFromAbove(np.empty(0, np.int64), np.empty((0, 2)))
    assert where_tracks_coincide([straight(0.0), nowhere], view, np.arange(101)) is None


@pytest.mark.parametrize("draw", [errors_over_time.draw, top_view.draw_all])
def test_legends_of_fourteen_estimators_stand_outside_the_data(fourteen: Comparison, draw: Draw) -> None:
    (one,) = draw(fourteen)
    figure = one.figure
    figure.draw_without_rendering()
    found = [*figure.legends, *(legend for axes in figure.axes if (legend := axes.get_legend()) is not None)]
    (legend,) = found
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes if axes.axison)
    labels = {text.get_text().partition(":")[0] for text in legend.get_texts()}
    assert labels >= set(fourteen.estimators)


def test_few_figures_come_first_and_all_when_requested(comparison: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    def named(name: str) -> Callable[[Comparison], Iterator[NamedFigure]]:
        return lambda _: iter([NamedFigure(name, "", Figure())])

    monkeypatch.setattr(figures, "_FEW", (named("one"),))
    monkeypatch.setattr(figures, "_MORE", (named("another"),))
    names = {choice: [figure.name for figure in drawn(comparison, choice)] for choice in CHOICES}
    assert names == {"few": ["one"], "all": ["one", "another"], "none": []}
