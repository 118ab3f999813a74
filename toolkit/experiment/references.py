"""Estimates of other systems from a recording, as runs that were not made here."""

from collections.abc import Iterable, Mapping

from toolkit.answers import Output, Run
from toolkit.audit.truth import steps_beside_camera
from toolkit.datasets.trajectories.belonging import (
    Reference,
    check_axes,
    check_body,
    check_clock,
    check_length_unit,
    of_the_camera,
    other_axes,
    range_s,
)
from toolkit.datasets.trajectories.formats import PosesFile
from toolkit.errors import DataError
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import TRUTH, plain_name
from toolkit.metrics.parts.against_truth import associate, median_period_ns, poses_at
from toolkit.sequence import LONGEST_NAME, Sequence, Truth
from toolkit.settings import SettingsError

_OTHER_TERMS = (
    "its start, its noise and its cost are its own, and it may have used the tracks that are withheld from the others"
)
_AS_FINAL = "it is listed as final, because a file does not show whether its poses use later measurements"


def reference_runs(references: Mapping[str, Trajectory], sequence: Sequence) -> tuple[Run, ...]:
    """Return a run for each estimate in a recording, with its poses at the frames as causal output."""
    read = "read from a file of the recording"
    return tuple(_run(name, trajectory, sequence, "causal", read) for name, trajectory in references.items())


def external_runs(files: Mapping[str, PosesFile], recording: Sequence, sequence: Sequence) -> tuple[Run, ...]:
    """Return a run for each trajectory file, with its poses at the frames as final output.

    ``recording`` is the whole of it, of which ``sequence`` may be a part. Raises DataError where a file
    is not of this recording: a wrong clock, unit of time, order of quaternions, body or number of rows is named.
    """
    return tuple(_external(name, poses, recording, sequence) for name, poses in files.items())


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


def check_names(references: Mapping[str, Trajectory], files: Mapping[str, PosesFile]) -> None:
    """Raise DataError where a trajectory file is given the name of an estimate that the recording brings."""
    taken = {plain_name(name): name for name in references}
    for name in files:
        if plain_name(name) in taken:
            raise DataError(f"the recording contains an estimate {taken[plain_name(name)]}; give {name} another name")


def _external(name: str, poses: PosesFile, recording: Sequence, sequence: Sequence) -> Run:
    trajectory, what = _stamped(poses, recording, sequence), str(poses.path)
    reference = Reference.of_recording(recording)
    check_clock(what, reference, trajectory.t_ns)
    check_length_unit(what, reference, trajectory.t_ns, trajectory.T_world_imu[:, :3, 3])
    matched = None
    if recording.truth is not None:
        pairs = associate(trajectory, recording.truth, median_period_ns(recording.frames_t_ns))
        matched = pairs.truth, pairs.estimate
    turn = check_body(poses, reference, trajectory.t_ns, matched, of_the_camera(recording))
    if turn is not None:
        raise DataError(f"{what}: its poses are of a body with other axes than the IMU's: {other_axes(turn)}")
    if matched is not None:
        check_axes(what, *matched)
    remarks = [] if recording.truth is not None else _of_another_scale(trajectory, sequence)
    read = f"read from {what} ({poses.format}, {len(poses)} poses)"
    return _run(name, trajectory, sequence, "final", read, *remarks, _AS_FINAL)


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
        return Trajectory(poses.t_ns, poses.T_world_imu)
    counts = dict.fromkeys((recording.frame_count, sequence.frame_count))
    if len(poses) not in counts:
        expected = " or ".join(map(str, counts))
        raise DataError(
            f"{poses.path}: {len(poses)} rows, but a {poses.format} file has one for every frame, and there are "
            f"{expected}; write a pose for each, or a format with stamps"
        )
    frames = recording if len(poses) == recording.frame_count else sequence
    return Trajectory(frames.frames_t_ns, poses.T_world_imu)


def _run(name: str, whole: Trajectory, sequence: Sequence, output: Output, read: str, *remarks: str) -> Run:
    """Return the run with a pose for every frame that the rule of association reaches."""
    frames_t_ns = sequence.frames_t_ns
    reached, poses = poses_at(whole.t_ns, whole.T_world_imu, frames_t_ns, median_period_ns(frames_t_ns))
    log = [f"{read}, not run here: {_OTHER_TERMS}", *remarks]
    if not reached.any():
        log.append(f"none of its poses ({range_s(whole.t_ns)}) reaches one of the frames ({range_s(frames_t_ns)})")
    at_frames = Trajectory(frames_t_ns[reached], poses)
    causal, final = (at_frames, None) if output == "causal" else (None, at_frames)
    return Run(name, "ok", causal, final, Landmarks.none(), timings=None, log=tuple(log))
