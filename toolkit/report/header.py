"""What stands above a table: the recording in a line, and the rules that all estimators had in common."""

from collections.abc import Iterator

from toolkit.experiment.comparison import Comparison
from toolkit.report.scores_json import path_length_m
from toolkit.report.table import Columns, shared_values
from toolkit.sequence import Sequence
from toolkit.settings import Noise, Window, outliers_in_words

_MOTION = {"twist": "body twists", "imu": "raw IMU", "none": "no motion measured (smooth motion assumed)"}
_WITHOUT_TRUTH = (
    "without ground truth the table shows how well an estimate explains tracks that none was given (held-out) and what "
    "it cost, the notes whether its innovations fit its covariance; not how far it is from the true path"
)


def sequence_line(sequence: Sequence) -> str:
    """Return the recording in one line: size, duration, true path, motion."""
    path_m = path_length_m(sequence)
    count = len(sequence.observations)
    sightings = f"{count} stereo observations" if count else "no image features"
    path = "no ground truth" if path_m is None else f"true path {path_m:.0f} m"
    motion = _MOTION[sequence.motion_kind]
    return f"{sequence.name}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, {sightings}, {motion}, {path}"


def header_lines(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield what stands above a table: the recording, pairs and coverage the rows share, the common rules, warnings.

    The warnings are the audit's: they hold for every row, whatever its status.
    """
    seeds = f", seeds {comparison.seeds[0]} to {comparison.seeds[-1]}" if comparison.over_seeds else ""
    yield sequence_line(comparison.sequence) + seeds
    shared = ", ".join(shared_values(comparison, columns))
    if shared:
        yield f"scored: {shared}"
    yield rules_line(comparison)
    warnings = [finding.fault for finding in comparison.findings if finding.warning or finding.blocking]
    if warnings:
        yield f"whatever its status, no result stands without what the audit says of: {', '.join(warnings)}"
    if comparison.sequence.truth is None and len(comparison.sequence.observations):
        yield _WITHOUT_TRUTH


def rules_line(comparison: Comparison) -> str:
    """Return the rules that estimators had in common: the window, whether its cap binds, the outlier policy."""
    settings, sequence = comparison.settings, comparison.sequence
    window = settings.window
    left_out = _left_out(sequence, window)
    thinned = f", so that {left_out} of {sequence.frame_count} frames have none" if left_out else ""
    return (
        f"window {window.seconds(sequence.motion_kind):g} s, at most {window.most_states} states{thinned}; "
        f"outliers: {outliers_in_words(settings.outliers)}"
        f"{_track_noise(settings.noise)}{_optional_parts(settings.noise)}"
    )


def _track_noise(noise: Noise) -> str:
    """Say what the errors of a track are taken for, where they are not taken for white."""
    if noise.tracks == "white":
        return ""
    if noise.tracks == "correlated":
        return "; noise of tracks: correlated, as stated"
    basis = "the whole recording" if noise.track_fit_s is None else f"the first {noise.track_fit_s:g} s"
    return f"; noise of tracks: fitted to {basis}, which causal answers know too early"


def _optional_parts(noise: Noise) -> str:
    """Say what is taken into account besides, where it is not as by default."""
    sigma = noise.disparity_scale
    scale = "" if sigma is None else f"; disparities scaled by 0 +- {100.0 * sigma:g} %, a state"
    return f"{scale}{'' if noise.bridge_gaps else '; gaps between tracks not bridged'}"


def _left_out(sequence: Sequence, window: Window) -> int:
    """Return how many frames have no state in a window, for it would hold too many."""
    last, left_out = -1, 0
    for since_ns in (sequence.frames_t_ns - sequence.frames_t_ns[:1]).tolist():
        interval = window.interval(since_ns, sequence.motion_kind)
        left_out += interval == last
        last = interval
    return left_out
