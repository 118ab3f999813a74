"""Figures show the data: one look, equal scale from above, nothing that squashes the rest, figures fit for a paper."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec.structs import asdict

from tests.report.conftest import compared
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array, about_z, interpolate_poses, se3
from toolkit.registry import defaults, discover
from toolkit.report import FigureFormat
from toolkit.report.curves import COLOURS, components, error_curves, look_numbers
from toolkit.report.figures import comparison as drawing
from toolkit.report.figures import save, style
from toolkit.report.figures.comparison import NOWHERE, view_of
from toolkit.report.figures.style import NamedFigure, new_figure, stroke_of
from toolkit.report.figures.trials import _label
from toolkit.sequence import Sequence
from toolkit.settings import Metrics, Settings
from toolkit.simulation import DRIVE, simulate

Draw = Callable[[Comparison], Iterator[NamedFigure]]
BEGINS = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}

OFFSET_M = np.array([0.3, -0.2, 0.1])
SIGMA_DEG, SIGMA_M = np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.4])


@pytest.fixture(scope="module")
def offset(sequence: Sequence, comparison: Comparison) -> Comparison:
    """The truth with every pose set off along its own axes and turned about its vertical, with stated covariances."""
    truth, t_ns = sequence.truth, sequence.frames_t_ns
    assert truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns)
    wrong = poses @ se3(about_z(np.radians(0.5)), OFFSET_M)
    cov = np.tile(np.diag(np.concatenate([np.radians(SIGMA_DEG), SIGMA_M]) ** 2), (t_ns.size, 1, 1))
    trajectory = Trajectory(t_ns, wrong, cov=cov)
    steady = comparison.runs[0]
    run = replace(steady, estimator="offset", causal=trajectory, final=trajectory)
    return compared(sequence, (run, steady))


@pytest.fixture(scope="module")
def fourteen(comparison: Comparison) -> Comparison:
    """One run under fourteen names; it need not be scored so many times."""
    one = comparison.outcomes[0]
    names = [f"estimator-{n}" for n in range(14)]
    again = (replace(one, estimator=name, run=replace(comparison.runs[0], estimator=name)) for name in names)
    return replace(comparison, outcomes=tuple(again))


def map_of(figure: Figure) -> Axes:
    """Return the axes that have a map in them, of a figure with its legend in other axes."""
    return next(axes for axes in figure.axes if axes.get_xlabel() == "x [m]")


def test_top_views_have_equal_scale_which_far_landmarks_do_not_squash(comparison: Comparison) -> None:
    shown = {one.name: one.figure for one in (*drawing.draw_all(comparison), *drawing.draw_each(comparison))}
    assert list(shown) == ["top_all", "top_steady", "top_astray", "top_late"]
    assert all(map_of(figure).get_aspect() == 1.0 for figure in shown.values())
    late = comparison.runs[2]
    points = late.landmarks.points_world.copy()
    points[:10] = 1e6
    spoiled = replace(late, landmarks=Landmarks(late.landmarks.track_ids, points))
    ((_, _, figure),) = drawing.draw_all(compared(comparison.sequence, (spoiled,)))
    low, high = map_of(figure).get_xlim()
    assert high - low < 500.0


def test_a_diverged_run_does_not_flatten_the_others(comparison: Comparison) -> None:
    (drawn,) = drawing.draw_errors(comparison)
    _, curves = error_curves(comparison)
    good_m = max(max(errors.position_m) for row, errors in curves.items() if row.status == "ok")
    position, _ = drawn.figure.axes
    assert position.get_ylim()[1] < 2.0 * good_m
    assert "astray" in position.get_title(loc="right")


@pytest.mark.parametrize("draw", [drawing.draw_errors, drawing.draw_all])
def test_a_comparison_of_failures_draws_nothing(comparison: Comparison, draw: object) -> None:
    broken = replace(comparison, outcomes=comparison.outcomes[3:])
    assert callable(draw)
    assert list(draw(broken)) == []


def test_the_bound_is_drawn_where_it_was_requested(run_estimator) -> None:
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    usual = compared(sequence, tuple(run_estimator(name, sequence) for name in ("dead-reckoning", "ekf")))
    assert list(drawing.draw_bound(usual)) == []
    requested = replace(usual, settings=Settings(metrics=Metrics(bound=True)))
    (drawn,) = drawing.draw_bound(requested)
    position = drawn.figure.axes[0]
    lines = {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in position.get_lines()}
    assert "thin: stated" in [text.get_text() for text in drawn.figure.legends[0].get_texts()]
    # Dead reckoning knows less than the bound's measurements tell, so it errs beyond it; both begin with the prior.
    assert lines["dead-reckoning both"][-1] > position.get_ylim()[0]
    assert lines["bound causal"][0] == pytest.approx(np.sqrt(np.trace(sequence.prior.cov[3:6, 3:6])), rel=1e-6)


def of_offset(offset: Comparison) -> dict[str, Array]:
    """Return the columns of the components of the estimator that is set off."""
    (row,) = (row for row in offset.lines if row.estimator == "offset")
    found = components(offset, row)
    assert found is not None
    return {name: np.array(column) for name, column in asdict(found).items()}


def stacked(found: dict[str, Array], *names: str) -> Array:
    return np.stack([found[name] for name in names], axis=1)


def test_components_are_estimate_minus_truth_in_the_worlds_axes_and_stated_deviations_turn_with_the_body(
    offset: Comparison, sequence: Sequence
) -> None:
    found, truth = of_offset(offset), sequence.truth
    assert truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, sequence.frames_t_ns)
    # Six digits are kept.
    np.testing.assert_allclose(stacked(found, "x_m", "y_m", "z_m"), poses[:, :3, :3] @ OFFSET_M, rtol=1e-5, atol=1e-12)
    turned_deg = stacked(found, "about_x_deg", "about_y_deg", "about_z_deg")
    np.testing.assert_allclose(np.linalg.norm(turned_deg, axis=1), 0.5, rtol=1e-5)
    estimate = offset.runs[0].final
    assert estimate is not None
    sigma_m = stacked(found, "sigma_x_m", "sigma_y_m", "sigma_z_m")
    np.testing.assert_allclose(sigma_m**2, (estimate.T_world_imu[:, :3, :3] ** 2) @ SIGMA_M**2, rtol=1e-4)
    sigma_deg = stacked(found, "sigma_about_x_deg", "sigma_about_y_deg", "sigma_about_z_deg")
    np.testing.assert_allclose((sigma_deg**2).sum(axis=1), (SIGMA_DEG**2).sum(), rtol=1e-4)


def test_the_band_is_three_deviations_all_of_the_error_is_shown_and_the_share_in_it_is_the_metrics(
    offset: Comparison,
) -> None:
    drawn = (*drawing.draw_telling_components(offset), *drawing.draw_other_components(offset))
    one = next(figure for figure in drawn if figure.name == "components_offset")
    found, axes = of_offset(offset), one.figure.axes[0]
    lower, upper, error = (np.asarray(line.get_ydata()) for line in axes.get_lines()[:3])
    np.testing.assert_allclose(upper, 3.0 * found["sigma_x_m"])
    np.testing.assert_allclose(lower, -upper)
    np.testing.assert_allclose(error, found["x_m"])
    assert axes.get_ylim()[1] > np.abs(error).max()
    (one,) = drawing.draw_nees(offset)
    (row,) = (row for row in offset.lines if row.estimator == "offset")
    share = row.value("nees_pose_in_band_percent")
    assert share is not None
    assert one.figure.axes[0].get_title(loc="right") == f"{share:.0f} %"


def test_a_run_without_poses_is_no_line_and_widens_no_view() -> None:
    straight = np.array([[0.0, 0.0], [100.0, 0.0]])
    (both, one) = (view_of(tracks, NOWHERE) for tracks in ([straight, NOWHERE], [straight]))
    np.testing.assert_array_equal(both, one)
    assert np.isfinite(view_of([NOWHERE], NOWHERE)).all()


@pytest.mark.parametrize("draw", [drawing.draw_errors, drawing.draw_all])
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


def test_in_narrow_panels_a_name_and_the_shares_in_the_band_do_not_meet() -> None:
    figure, panels = style.panels_of(list(discover()))
    for axes in panels.values():
        style.annotate(axes, "100, 99 %")
    figure.draw_without_rendering()
    for axes in panels.values():
        assert not axes._left_title.get_window_extent().overlaps(axes._right_title.get_window_extent())


@pytest.mark.parametrize("kind", BEGINS)
def test_a_figure_is_of_its_format_and_the_same_every_time(tmp_path, kind: FigureFormat) -> None:
    for name in ("one", "two"):
        figure = new_figure(2.0)
        figure.add_subplot().plot([0, 1], [1, 0], label="a line")
        (tmp_path / name).mkdir()
        assert save([NamedFigure("line", "A line.", figure)], tmp_path / name, kind) == {f"line.{kind}": "A line."}
    one, two = ((tmp_path / name / f"line.{kind}").read_bytes() for name in ("one", "two"))
    assert one.startswith(BEGINS[kind])
    assert one == two


def test_a_legend_shows_whole_dashes_and_words_beside_points_cover_none() -> None:
    for dashes in (one for ones in style._LINE_OF.values() for one in ones if not isinstance(one, str)):
        assert sum(dashes[1]) * style._SAMPLE_PT <= style._SAMPLE_EM * style.LEGEND_PT
    axes = new_figure(2.0).add_subplot()
    _label(axes, [("default", (0.5, 0.5))] * 6)
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) == 4  # one on every side of the point
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_an_estimator_has_one_look_of_its_own_whatever_it_is_compared_with_and_one_colour() -> None:
    names = [*discover(), "one of my own"]
    strokes = {(name, output): stroke_of(names, name, output) for name in names for output in ("causal", "final")}
    assert len({str(stroke) for stroke in strokes.values()}) == len(strokes)
    together = look_numbers(names)
    for name in names:
        assert strokes[name, "causal"]["color"] == strokes[name, "final"]["color"]
        assert look_numbers([name])[name] == together[name]
    assert len({together[name] % COLOURS for name in (*defaults(), "one of my own")}) == len(defaults()) + 1
