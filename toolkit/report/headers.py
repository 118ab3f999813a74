"""What stands above the table of a comparison: which metrics have a column, the recording, the common rules, the noise.

Which metrics have a column by default is in the metrics' records (:mod:`toolkit.metrics`).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np

from toolkit.experiment.comparison import Comparison
from toolkit.metrics import Metric, known_metrics, metrics_called
from toolkit.noise import TrackWeight
from toolkit.report.scores import path_length_m
from toolkit.report.text import cell
from toolkit.sequence import Sequence
from toolkit.settings import Window, outlier_summary

# First columns of a real drive: the drift, and the error after a fit that keeps the vertical. After an SE(3) fit of a
# drive, differences of good estimators are chance (one model solved twice differed by a metre). The drift replaces the
# RPE.
_LEADING, _SHOWN_AS_DRIFT = ("kitti_t_percent", "ate_yaw_m"), "rpe_100m_percent"
# The columns of a table: None for the usual ones, "all", or metrics by key or name.
Columns = None | Literal["all"] | tuple[str, ...]
_MOTION = {"twist": "body twists", "imu": "raw IMU", "none": "no motion measured (smooth motion assumed)"}


def requested_columns(names: tuple[str, ...]) -> Columns:
    """Return the columns that some names ask for: the usual ones where there are none, all for the one word "all".

    Raises UnknownNameError for a name that is no metric's.
    """
    if names == ("all",):
        return "all"
    metrics_called(names)
    return names or None


def shown_metrics(comparison: Comparison, columns: Columns = None) -> tuple[Metric, ...]:
    """Return the metrics that have a column; without any value a metric has one only if it is named.

    Pairs and coverage, whose records say so, are a column where rows differ; else :func:`shared_values` has them.
    """
    if columns is not None and columns != "all":
        return metrics_called(columns)
    valued = [metric for metric in known_metrics() if any(v is not None for v in _values(comparison, metric))]
    if columns == "all":
        return tuple(valued)
    if comparison.over_seeds:
        return tuple(metric for metric in valued if metric.over_seeds)
    differing = [m for m in valued if m.table == "where rows differ" and len(set(_values(comparison, m))) > 1]
    return (*differing, *usual_metrics(valued, real=comparison.sequence.provenance.format != "simulated"))


def usual_metrics(valued: list[Metric], *, real: bool) -> list[Metric]:
    """Return the columns of one run by default, of the metrics that have values.

    Those of a ``real`` recording are those of a drive where it is long enough for the KITTI benchmark's drift.
    """
    usual = [metric for metric in valued if metric.table == "always"]
    leading = [metric for key in _LEADING for metric in valued if metric.key == key]
    if not real or len(leading) < len(_LEADING):
        return usual
    return [*leading, *(metric for metric in usual if metric.key not in (*_LEADING, _SHOWN_AS_DRIFT))]


def explained_metrics(comparison: Comparison, columns: Columns = None) -> tuple[Metric, ...]:
    if columns is None and comparison.over_seeds:
        return tuple(metric for metric in known_metrics() if metric.over_seeds)
    if columns is None:
        shown = shown_metrics(comparison)
        return tuple(metric for metric in known_metrics() if metric in shown or metric.table != "on request")
    return known_metrics() if columns == "all" else metrics_called(columns)


def shared_values(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield, in words, pairs and coverage where they have no column: one value, or from the least to the most."""
    shown = shown_metrics(comparison, columns)
    for metric in known_metrics():
        values = sorted({value for value in _values(comparison, metric) if value is not None})
        if metric.table == "where rows differ" and metric not in shown and values:
            ends = " to ".join(dict.fromkeys(cell(value, metric) for value in (values[0], values[-1])))
            yield " ".join(filter(None, (metric.name, ends, metric.unit)))


def _values(comparison: Comparison, metric: Metric) -> list[float | None]:
    return [row.value(metric.key) for row in comparison.lines]


def sequence_line(sequence: Sequence) -> str:
    path_m = path_length_m(sequence)
    count = len(sequence.observations)
    sightings = f"{count} stereo observations" if count else "no image features"
    path = "no ground truth" if path_m is None else f"true path {path_m:.0f} m"
    motion = _MOTION[sequence.motion_kind]
    return f"{sequence.name}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, {sightings}, {motion}, {path}"


def header_lines(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield what stands above a table: the recording, pairs and coverage the rows share, the common rules."""
    seeds = f", seeds {comparison.seeds[0]} to {comparison.seeds[-1]}" if comparison.over_seeds else ""
    yield sequence_line(comparison.sequence) + seeds
    shared = ", ".join(shared_values(comparison, columns))
    if shared:
        yield f"scored: {shared}"
    yield rules_line(comparison)
    if len(comparison.sequence.observations):
        yield noise_line(comparison)


def rules_line(comparison: Comparison) -> str:
    """Return the rules that estimators had in common: the window, whether its cap binds, outliers, budget of tracks."""
    settings, sequence = comparison.settings, comparison.sequence
    window = settings.window
    left_out = _left_out(sequence, window)
    thinned = f", so that {left_out} of {sequence.frame_count} frames have none" if left_out else ""
    budget, of_all = sequence.track_budget, len(replace(sequence, track_budget=None).visible) / sequence.frame_count
    return (
        f"window {window.seconds(sequence.motion_kind):g} s, at most {window.most_states} states{thinned}; "
        f"outliers: {outlier_summary(settings.outliers)}"
        f"{'' if budget is None else f'; at most {budget} of {of_all:.0f} tracks a frame'}"
        f"{'' if settings.noise.bridge_gaps else '; gaps between tracks not bridged'}"
        f"{'; started from the truth' if settings.start == 'truth' else ''}"
    )


_MOTION_NOISE = {"twist": "odometry", "imu": "IMU", "none": "motion"}


def noise_line(comparison: Comparison) -> str:
    rig, settings, measured = comparison.sequence.rig, comparison.settings.noise, comparison.measured
    tracks = motion = ""
    if measured is not None:
        tracks, scale = tracks_measured(measured.tracks), measured.motion
        times = f"{scale.value:.2g} +- {scale.error:.1g} times as noisy as stated"
        motion = "as stated" if scale.value == 1.0 else times
    if settings.track_weight != "auto":
        tracks = f"each counted at {rig.track_weight:.2g} of its information, as set"
    if settings.motion_scale != "auto":
        motion = f"{settings.motion_scale:.3g} times as noisy as stated, as set"
    line = (
        f"noise: sightings {float(np.sqrt(rig.cov_uv_px2[0, 0])):.2g} px, {tracks}; "
        f"{_MOTION_NOISE[comparison.sequence.motion_kind]} {motion}"
    )
    if measured is None:
        return line
    if measured.why_not:
        return f"{line} (not measured: {measured.why_not})"
    basis = "recording" if settings.measured_s is None else f"first {settings.measured_s:g} s"
    return f"{line}; measured on the {basis}"


def tracks_measured(weight: TrackWeight) -> str:
    """Return in words how correlated the errors of a track are, and what a sighting counts for then."""
    if not weight.correlation:
        return "white along tracks"
    along = f"errors along tracks correlated, {weight.correlation:.2f} from frame to frame"
    if weight.value == 1.0:
        return f"each counted in full ({along}, but smaller than stated)"
    return f"each counted at {weight.value:.2g} +- {weight.error:.1g} of its information ({along})"


def _left_out(sequence: Sequence, window: Window) -> int:
    """Return how many frames have no state in the window, because it would hold too many."""
    last, left_out = -1, 0
    for since_ns in (sequence.frames_t_ns - sequence.frames_t_ns[:1]).tolist():
        interval = window.interval(since_ns, sequence.motion_kind)
        left_out += interval == last
        last = interval
    return left_out
