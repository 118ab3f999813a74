"""How often a bad run says so, and how often a sound one raises a false alarm; not part of the tests.

A scenario is a fault of toolkit.simulation.faults in a stretch of a simulated recording, or none, with the truth taken
away. The recording is audited and run as a user would; then the truth is put back for the error: the RMS of the
position after an alignment, of the causal answer where there is one. A run is bad where its error is above three times
that of the same estimator on the sound recording, or where it has none. A run says so where it is not ok, is marked
overconfident or contradicted, where a note says that its gate refused much, that it explains withheld tracks worse
than dead reckoning, that it differs from the measured motion or uses a motion alone that others contradict, or where
the audit found something in its recording, repaired or not; faults that could not be decided do not count. In a sound
recording all of that is a false alarm, and so is the mark timid.

A draw is a number: it deals every fault to one recording and one stretch of it, and to two cheap estimators, which take
turns, with a dear one every fourth time. Thresholds may be chosen on some draws; others are not to be looked at while
they are. A comparison is of the estimators that meet a fault. Those of a sound stretch are compared all together and
two by two, as they meet faults, and what any of these comparisons says is a false alarm.

    python tests/benchmarks/status_power.py run 1 runs.jsonl     a line a run; goes on where it was stopped
    python tests/benchmarks/status_power.py table 1 runs.jsonl   power and false alarms; exit 1 beside the bar
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from toolkit.answers import Output, Run
from toolkit.errors import VislamError
from toolkit.experiment.comparison import Row, consistency_of
from toolkit.experiment.contests import too_far
from toolkit.experiment.recording import Prepared, Recording, prepare
from toolkit.experiment.units import OUTPUTS, Outcome, Unit, outcome_of, run_estimator
from toolkit.metrics import Evaluation, ate
from toolkit.metrics.innovations import ACCEPTED, refuses_much
from toolkit.metrics.reprojection import RATIO
from toolkit.progress import SILENT
from toolkit.sequence import Sequence as Recorded
from toolkit.simulation import SCENARIOS, faults, simulate

LENGTH_S = {"drive": 12.0, "drive-imu": 12.0, "flight": 6.0}
Result = TypeVar("Result")
FAULTS: dict[str, Callable[..., Recorded]] = {
    f"{injector.__name__} {dose:g}": partial(injector, dose=dose)
    for injector, doses in (
        (faults.dropped_sightings, (0.1, 0.5)),
        (faults.blackout, (1.0, 3.0)),
        (faults.outlier_tracks, (0.1, 0.3, 0.6)),
        (faults.moving_objects, (0.3, 0.5, 0.8)),
        (faults.few_tracks, (3, 10)),
        (faults.one_sided_view, (0.5, 0.8)),
        (faults.swapped_images, (0.1, 1.0)),
        (faults.swapped_coordinates, (0.1, 1.0)),
        (faults.shifted_pixels, (20, 5000)),
        (faults.misaligned_rows, (4, 12)),
        (faults.motion_gap, (0.5, 1.0, 3.0)),
        (faults.disturbed_motion, (0.5, 2.0)),
        (faults.spike, (5.0, 1e300)),
        (faults.nan_span, (0.25, 1.0)),
        (faults.linear_unit, (0.8, 1.1, 3.6)),
        (faults.angular_unit, (1.2, 57.3)),
        (faults.gyro_bias, (0.01, 0.05)),
        (faults.wrong_noise, (0.33, 2.0, 5.0)),
        (faults.camera_clock, (-0.05, 0.02, 0.25)),
        (faults.clock_jump, (-0.5, 0.5)),
        (faults.standstill, (5.0, 10.0)),
        (faults.identity_intrinsics, (0.0, 1.0)),
        (faults.baseline_unit, (1.1, 1000.0)),
        (faults.extrinsic_unit, (1000.0,)),
        (faults.inverted_extrinsic, (1.0,)),
        (faults.turned_camera, (0.01, 0.05)),
    )
    for dose in doses
}
# So many stretches of each recording a draw has, and in so many of these faults are planted.
STRETCHES, FAULTY_STRETCHES = 7, 5
CHEAP = ("dead-reckoning", "ekf", "ekf-slam", "mapping", "msckf", "msckf-fej", "msckf-slam", "riekf", "seed-ekf")
DEAR = ("batch", "fixed-lag", "smart", "isam2", "batch", "fixed-lag", "smart", "iekf")
SOUND = ""
LIMIT = 3.0
TELLING_MARKS = ("overconfident", "contradicted")


@dataclass(frozen=True)
class Scenario:
    """A fault, or none, in a stretch of a simulated recording, and the estimators that meet it."""

    recording: str
    seed: int
    fault: str
    estimators: tuple[str, ...]


def scenarios(draw: int) -> list[Scenario]:
    """Return the scenarios of a draw: every fault once, in a recording that is drawn.

    Sound stretches come first: all cheap estimators run on them, and of the dear ones those that meet a fault there.
    """
    first_seed, faulty = 1000 * draw, list[Scenario]()
    places = np.random.default_rng(first_seed).integers(len(LENGTH_S), size=len(FAULTS))
    drawn = np.array(list(LENGTH_S))[places].tolist()
    for i, (fault, recording) in enumerate(zip(FAULTS, drawn, strict=True)):
        dear = (DEAR[(i // 4) % len(DEAR)],) if i % 4 == 3 else ()
        seed = first_seed + (i // len(LENGTH_S)) % FAULTY_STRETCHES
        # With each draw a fault meets the next of the cheap estimators.
        faulty.append(Scenario(recording, seed, fault, (*_neighbours(2 * i + draw - 4), *dear)))
    sound = []
    for seed in range(first_seed, first_seed + STRETCHES):
        for recording in LENGTH_S:
            here = [one for one in faulty if (one.recording, one.seed) == (recording, seed)]
            dear = sorted({name for one in here for name in one.estimators} - set(CHEAP))
            sound.append(Scenario(recording, seed, SOUND, (*CHEAP, *dear)))
    return sound + faulty


def _neighbours(first: int) -> tuple[str, str]:
    """Return two of the cheap estimators, which take turns."""
    return CHEAP[first % len(CHEAP)], CHEAP[(first + 1) % len(CHEAP)]


def comparisons(scenario: Scenario) -> list[tuple[str, ...]]:
    """Return the estimators that are compared with each other; in a sound stretch every two that meet faults, too."""
    two_by_two = [_neighbours(first) for first in range(len(CHEAP))] if scenario.fault == SOUND else []
    return [scenario.estimators, *two_by_two]


@dataclass(frozen=True)
class Ended:
    """How one run ended, and what it and the audit of its recording said without the truth."""

    draw: int
    recording: str
    seed: int
    fault: str
    estimator: str
    error_m: float | None = None
    status: str = "ok"
    mark: str = ""
    found: Sequence[str] = ()
    log: Sequence[str] = ()
    refuses: bool = False
    harms: bool = False
    contradicts: bool = False

    @property
    def is_reported(self) -> bool:
        """Say whether its status, its mark, a note, or the audit tells of a fault."""
        by_mark, by_notes = self.mark in TELLING_MARKS, self.refuses or self.harms or self.contradicts
        return bool(self.found) or self.status != "ok" or by_mark or by_notes

    @property
    def is_alarm(self) -> bool:
        """Say whether anything but ``ok`` is said."""
        return self.is_reported or bool(self.mark)


def is_bad(run: Ended, sound: Ended) -> bool:
    """Say whether a fault costs more than the limit, or the result."""
    if run.error_m is None:
        return True
    return sound.error_m is not None and run.error_m > LIMIT * sound.error_m


def stretch(recording: str, seed: int) -> Recorded:
    """Return some seconds of a simulated recording: its beginning, or with odd seeds from a time drawn."""
    length_s = LENGTH_S[recording]
    whole = simulate(SCENARIOS[recording], seed)
    begin_s = np.random.default_rng(seed).uniform(1.0, 59.0 - length_s) if seed % 2 else 0.0
    inside = (whole.frames_s >= begin_s) & (whole.frames_s <= begin_s + length_s)
    return whole.with_frames(np.flatnonzero(inside))


def planted(scenario: Scenario) -> Recorded | None:
    """Return the recording of a scenario, or None where its fault cannot be planted in such a one."""
    sound = stretch(scenario.recording, scenario.seed)
    if scenario.fault == SOUND:
        return sound
    try:
        return FAULTS[scenario.fault](sound, seed=scenario.seed + sorted(FAULTS).index(scenario.fault))
    except VislamError:
        return None


def ended(draw: int, scenario: Scenario) -> Iterator[Ended]:
    """Run a scenario's estimators and put the truth back for their errors; nothing where the fault cannot be planted.

    A recording or a run that is refused has no error and says why.
    """
    recorded = planted(scenario)
    if recorded is None:
        return
    prepared = _unless_refused(partial(prepare, Recording(replace(recorded, truth=None))))
    rows = dict[str, list[Row]]()
    lines = dict[str, Ended]()
    for name in scenario.estimators:
        run = prepared
        if isinstance(prepared, Prepared):
            run = _unless_refused(partial(run_estimator, Unit(prepared, 0, name), prepared, SILENT))
        one = Ended(draw, scenario.recording, scenario.seed, scenario.fault, name)
        if isinstance(run, str):
            lines[name] = replace(one, status="refused", log=(run,))
        elif isinstance(run, Run) and isinstance(prepared, Prepared):
            outcome = outcome_of(run, prepared.sequence, 0)
            rows[name] = [row for row in (Row(output, (outcome,)) for output in OUTPUTS) if not row.repeats_causal]
            lines[name] = _scored(one, run, outcome, prepared, replace(prepared.sequence, truth=recorded.truth))
    compared = [[row for name in names for row in rows.get(name, ())] for names in comparisons(scenario)]
    contradicting = {one.row.estimator for of_some in compared for one in too_far(of_some)}
    for name, line in lines.items():
        yield replace(line, contradicts=name in contradicting)


def _unless_refused(make: Callable[[], Result]) -> Result | str:
    """Return what a function makes, or in words why it refuses to."""
    try:
        return make()
    except VislamError as reason:
        return str(reason)


def _scored(one: Ended, run: Run, outcome: Outcome, prepared: Prepared, with_truth: Recorded) -> Ended:
    scored = list(outcome.outputs.values())
    verdicts = [found.verdict for found in map(consistency_of, ([output] for output in scored)) if found is not None]
    causal = outcome.outputs.get("causal")
    accepted = None if causal is None else causal.scores.values[ACCEPTED]
    return replace(
        one,
        error_m=_error_m(run, with_truth),
        status=run.status,
        mark=next((verdict for verdict in verdicts if verdict != "consistent"), ""),
        found=tuple(sorted(finding.fault for finding in prepared.findings)),
        log=run.log,
        refuses=accepted is not None and refuses_much(accepted),
        harms=any(RATIO in output.scores.notes and output.scores.values[RATIO] is not None for output in scored),
    )


def _error_m(run: Run, sequence: Recorded) -> float | None:
    """Return the RMS position error, aligned by what the sensors leave open: heading and position, or the pose."""
    output: Output = "final" if run.causal is None else "causal"
    if run.trajectory(output) is None:
        return None
    aligned = "ate_se3_m" if sequence.motion_kind == "twist" else "ate_yaw_m"
    value = ate.score(Evaluation(run, output, sequence)).values[aligned]
    return None if value is None or not np.isfinite(value) else float(value)


def run_draw(draw: int, file: Path) -> None:
    """Append a line a run to a file, without the scenarios that it has."""
    lines = read(file)
    done = {(one.recording, one.seed, one.fault, one.estimator) for one in lines}
    for scenario in scenarios(draw):
        where = (scenario.recording, scenario.seed, scenario.fault)
        missing = [name for name in scenario.estimators if (*where, name) not in done]
        for one in ended(draw, scenario) if missing else ():
            if one.estimator in missing:
                with file.open("a") as out:
                    out.write(json.dumps(asdict(one)) + "\n")
        print(*where, flush=True)


def read(file: Path) -> list[Ended]:
    """Return the runs of a file; none where it is not there."""
    return [Ended(**json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []


def print_table(lines: list[Ended]) -> bool:
    """Print power and false alarms, by estimator and by fault, and every silent run; say whether the bar is reached."""
    sound = {(one.recording, one.seed, one.estimator): one for one in lines if one.fault == SOUND}
    pairs = [(one, sound.get((one.recording, one.seed, one.estimator))) for one in lines if one.fault != SOUND]
    bad = [one for one, clean in pairs if clean is not None and is_bad(one, clean)]
    reported, alarms = [one for one in bad if one.is_reported], [one for one in sound.values() if one.is_alarm]
    harmless = [one for one, clean in pairs if clean is not None and not is_bad(one, clean)]
    print(f"{len(pairs)} faulty runs, {len(bad)} bad: {len(reported)} of them say so ({_percent(reported, bad)})")
    print(f"{len(sound)} sound runs: {len(alarms)} raise a false alarm ({_percent(alarms, sound)})")
    warned = [one for one in harmless if one.is_reported]
    print(f"{len(harmless)} runs that a fault cost less: {len(warned)} tell of it ({_percent(warned, harmless)})")
    by = Counter(_first_to_tell(one) for one in reported)
    print(f"what says so first of audit, status, mark, gate and comparison: {dict(by)}")
    for key in ("estimator", "fault"):
        for name in sorted({getattr(one, key) for one in bad}):
            of_name = [one for one in bad if getattr(one, key) == name]
            print(f"{name:<24} bad {len(of_name):>3}, silent {sum(not one.is_reported for one in of_name):>3}")
    for one in (*(one for one in bad if not one.is_reported), *alarms):
        what = "false alarm" if one.fault == SOUND else f"silent: {one.fault}"
        print(
            f"{what}, {one.recording} {one.seed}, {one.estimator}: {one.error_m} m, {one.status} {one.mark} {one.found}"
        )
    return len(reported) >= 0.95 * len(bad) and len(alarms) <= 0.02 * len(sound)


def _first_to_tell(run: Ended) -> str:
    if run.found:
        return "audit"
    if run.status != "ok":
        return "status"
    if run.mark in TELLING_MARKS:
        return "mark"
    return "gate" if run.refuses or run.harms else "comparison"


def _percent(part: Sized, whole: Sized) -> str:
    return f"{100.0 * len(part) / max(len(whole), 1):.1f} %"


def main(words: list[str]) -> int:
    """Run a draw, or print its table and exit 1 beside the bar: 95 % of the bad say so, at most 2 % of the sound do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("draw", type=int, help="its number, 1 or more")
    parser.add_argument("file", type=Path)
    wanted = parser.parse_args(words)
    if wanted.what == "run":
        run_draw(wanted.draw, wanted.file)
        return 0
    return 0 if print_table([one for one in read(wanted.file) if one.draw == wanted.draw]) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
