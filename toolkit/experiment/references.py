"""Estimates of other systems from a recording, as runs that were not made here."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.answers import Output, Run
from toolkit.audit.truth import steps_beside_camera
from toolkit.datasets.trajectories import read_poses
from toolkit.datasets.trajectories.belonging import Reference, body_of, of_the_camera, other_axes, range_s
from toolkit.datasets.trajectories.covariances import CovConvention, StatedCovariances
from toolkit.datasets.trajectories.formats import PosesFile
from toolkit.errors import DataError
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import TRUTH
from toolkit.files.writing import plain_name
from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import body_errors, with_covariances
from toolkit.metrics.parts.evaluation import STAMP_TOLERANCE_NS, Evaluation, associate, median_period_ns, poses_at
from toolkit.metrics.parts.readings import likelier_reading
from toolkit.metrics.parts.scores import Unavailable
from toolkit.sequence import LONGEST_NAME, Sequence, Truth
from toolkit.settings import SettingsError

_OTHER_TERMS = (
    "its start, its noise and its cost are its own, and it may have used the tracks that are withheld from the others"
)
_SAID = ("causal", "final")
_NO_CONVENTION = "what its covariances mean is not said: name it with --cov-convention"
_AS_FINAL = "it is listed as final, because a file does not show whether its poses use later measurements"


@dataclass(frozen=True, eq=False)
class ExternalFile:
    """The file of another system, and which kind of output it is, None where that is not said."""

    poses: PosesFile
    output: Output | None = None


def read_external(given: Path, cov_convention: CovConvention | None = None) -> ExternalFile:
    """Read FILE, FILE:causal or FILE:final; ``cov_convention`` is that of its covariances where it does not say it.

    Raises DataError as :func:`~toolkit.datasets.trajectories.read_poses`.
    """
    name, _, last = str(given).rpartition(":")
    if name and last in _SAID and not given.exists():
        return ExternalFile(read_poses(Path(name), cov_convention), "causal" if last == "causal" else "final")
    return ExternalFile(read_poses(given, cov_convention))


def runs_of_others(
    brought: Mapping[str, Trajectory], files: Mapping[str, ExternalFile], recording: Sequence, sequence: Sequence
) -> tuple[Run, ...]:
    """Return a run for each estimate that a recording brings, as causal output, and for each trajectory file.

    A file is final output, or what it is said to be. ``recording`` is the whole of it, of which ``sequence`` may be a
    part. Raises DataError where a file has the name of an estimate, or is not of this recording: a wrong clock, unit of
    time, order of quaternions, body or number of rows is named.
    """
    taken = {plain_name(name): name for name in brought}
    for name in files:
        if plain_name(name) in taken:
            raise DataError(f"the recording contains an estimate {taken[plain_name(name)]}; give {name} another name")
    read = "read from a file of the recording"
    ours = [_run(name, trajectory, sequence, "causal", read) for name, trajectory in brought.items()]
    return (*ours, *(_external(name, file, recording, sequence) for name, file in files.items()))


def check_file_names(names: Iterable[str], estimators: Iterable[str]) -> None:
    """Raise SettingsError for a trajectory whose name is no file's, or is one of an estimator, the truth or another."""
    taken = {plain_name(name): name for name in (TRUTH, *estimators)}
    for name in names:
        plain = plain_name(name)
        if len(plain) > LONGEST_NAME:
            raise SettingsError(f"a trajectory's name of {len(plain)} characters is too long for a file; shorten it")
        if not plain or plain in taken:
            why = f"is taken by {taken[plain]}" if plain else "has no letter or digit"
            raise SettingsError(f"a trajectory's name {name} {why}; choose another")
        taken[plain] = f"another trajectory, {name}"


def _external(name: str, file: ExternalFile, recording: Sequence, sequence: Sequence) -> Run:
    poses = file.poses
    trajectory, what = _stamped(poses, recording, sequence), str(poses.path)
    matched = None
    if recording.truth is not None:
        pairs = associate(trajectory, recording.truth, median_period_ns(recording.frames_t_ns))
        matched = pairs.truth, pairs.estimate
    turn = body_of(poses, Reference.of_recording(recording), trajectory.t_ns, matched, of_the_camera(recording))
    if turn is not None and turn.is_other_body:
        axes = other_axes(turn.R_truth_body)
        raise DataError(f"{what}: its poses are of a body with other axes than the IMU's: {axes}")
    remarks = [] if recording.truth is not None else _of_another_scale(trajectory, sequence)
    read = f"read from {what} ({poses.format}, {len(poses)} poses)"
    remarks += _of_covariances(poses.covariances, trajectory, recording)
    as_what = _AS_FINAL if file.output is None else f"it is listed as {file.output}, as was said"
    return _run(name, trajectory, sequence, file.output or "final", read, *remarks, as_what)


def _of_covariances(stated: StatedCovariances | None, trajectory: Trajectory, recording: Sequence) -> list[str]:
    """Remark on covariances whose convention is not said, or another one by an independent truth."""
    if stated is None:
        return []
    unsaid = [_NO_CONVENTION] if stated.convention is None else []
    if recording.truth is None or not recording.truth.independent:
        return unsaid
    run = Run("", "ok", None, trajectory, Landmarks.none(), timings=None)
    try:
        errors = body_errors(Evaluation(run, "final", recording))
    except Unavailable:
        return unsaid
    likelier = likelier_reading(stated, trajectory.T_world_imu, lambda cov: with_covariances(errors, cov))
    return ["; ".join((*unsaid, likelier))] if likelier else unsaid


def _of_another_scale(trajectory: Trajectory, sequence: Sequence) -> list[str]:
    """Remark, where there is no truth, on steps that are longer or shorter than the stereo tracks alone show."""
    found = steps_beside_camera(sequence, Truth(trajectory.t_ns, trajectory.T_world_imu))
    if found is None:
        return []
    times = f"{found.value:.3f} +- {found.error:.3f} times as long as those of the camera by its stereo tracks"
    return [f"its steps are {times}: another unit or scale, or a baseline or a focal length that is off"]


def _stamped(poses: PosesFile, recording: Sequence, sequence: Sequence) -> Trajectory:
    """Return the poses with their stamps, which are the frames' where the format has none."""
    if poses.t_ns is not None:
        return poses.trajectory(poses.t_ns)
    counts = dict.fromkeys((recording.frame_count, sequence.frame_count))
    if len(poses) not in counts:
        expected = " or ".join(map(str, counts))
        raise DataError(
            f"{poses.path}: {len(poses)} rows, but a {poses.format} file has one for every frame, and there are "
            f"{expected}; write a pose for each, or a format with stamps"
        )
    frames = recording if len(poses) == recording.frame_count else sequence
    return poses.trajectory(frames.frames_t_ns)


def _run(name: str, whole: Trajectory, sequence: Sequence, output: Output, read: str, *remarks: str) -> Run:
    """Return the run with a pose for every frame that the rule of association reaches.

    Velocities, biases and covariances are those of the frame's own stamp, and NaN where a pose is interpolated.
    """
    frames_t_ns = sequence.frames_t_ns
    reached, poses = poses_at(whole.t_ns, whole.T_world_imu, frames_t_ns, median_period_ns(frames_t_ns))
    log = [f"{read}, not run here: {_OTHER_TERMS}", *remarks]
    if not reached.any():
        log.append(f"none of its poses ({range_s(whole.t_ns)}) reaches one of the frames ({range_s(frames_t_ns)})")
    at_ns = frames_t_ns[reached]
    row = np.clip(np.searchsorted(whole.t_ns, at_ns - STAMP_TOLERANCE_NS), 0, len(whole) - 1)
    same = np.abs(whole.t_ns[row] - at_ns) <= STAMP_TOLERANCE_NS

    def there(values: Array | None) -> Array | None:
        return None if values is None else np.where(same.reshape(-1, *[1] * (values.ndim - 1)), values[row], np.nan)

    at_frames = Trajectory(at_ns, poses, there(whole.v_world), there(whole.bias), there(whole.cov))
    causal, final = (at_frames, None) if output == "causal" else (None, at_frames)
    return Run(name, "ok", causal, final, Landmarks.none(), timings=None, log=tuple(log))
