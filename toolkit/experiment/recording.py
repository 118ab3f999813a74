"""From a source to what every estimator reads: loaded, audited, cut, with its noise and a state to start from."""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from toolkit.answers import Run
from toolkit.audit import Audit, Finding, audit, checked_again
from toolkit.datasets import check_built_in, is_built_in, load_sequence, told_of_both
from toolkit.datasets.io.truth import load_truth, with_truth
from toolkit.errors import DataError
from toolkit.initialization import start_from_measurements, start_from_truth
from toolkit.measurements import NS_PER_S, Prior
from toolkit.noise import Card, MeasuredNoise, card_of, measured_noise, with_gap_twists
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Sequence, why_not_sightings
from toolkit.settings import DEFAULTS, Frontend, Noise, Settings, SettingsError, TrackUse, Varied
from toolkit.simulation import SCENARIOS, simulate
from toolkit.simulation.faults import Doses, planted
from toolkit.threads import on_one_thread

Start = Literal["measurements", "truth"]
STARTS: dict[Start, Callable[[Sequence], Prior]] = {"measurements": start_from_measurements, "truth": start_from_truth}


@dataclass(frozen=True)
class Part:
    """Which frames of a recording are used: seconds after its first frame, ends included, and one frame in ``every``.

    Motion samples and truth stay whole. Raises SettingsError for a time or a step that selects nothing.
    """

    from_s: float = 0.0
    to_s: float | None = None
    every: int = 1

    def __post_init__(self) -> None:
        to_s = math.inf if self.to_s is None else self.to_s
        if not 0.0 <= self.from_s < to_s:
            raise SettingsError(f"{self}: a part begins and ends at seconds after the first frame, and ends last")
        if self.every < 1:
            raise SettingsError(f"every is {self.every}; one frame in N is used, N is 1 or more")

    def __str__(self) -> str:
        end = "the end" if self.to_s is None else f"{self.to_s:g} s"
        thinned = "" if self.every == 1 else f", one frame in {self.every}"
        return f"from {self.from_s:g} s to {end}{thinned}"


WHOLE = Part()

# GTSAM's keys have 56 bits for the number of a landmark.
_LARGEST_ID = 2**56 - 1


@dataclass(frozen=True)
class Recording:
    """A source under one seed, and how it is prepared before an estimator reads it.

    ``source`` is a path, a built-in name or a sequence; ``truth`` a TUM file; ``keep`` names faults that the audit
    reports and leaves as they are. ``part`` selects the frames that are used, ``max_frames`` the first of these;
    ``duration_s`` cuts the recording before that, and a simulation is made that long. ``faults`` are planted in the
    part that is run, by name and dose, after the audit and before its noise is measured. ``vary`` says which parts of a
    simulation the seed draws; ``card`` requests the card of its tracks.
    """

    source: str | Sequence
    seed: int = 0
    truth: Path | None = None
    keep: frozenset[str] = frozenset()
    start: Start = "measurements"
    max_frames: int | None = None
    duration_s: float | None = None
    noise: Noise = DEFAULTS.noise
    frontend: Frontend = DEFAULTS.frontend
    tracks: TrackUse = DEFAULTS.tracks
    vary: Varied = DEFAULTS.vary
    card: bool = False
    part: Part = WHOLE
    faults: Doses | None = None

    @classmethod
    def under(cls, settings: Settings, source: str | Sequence, seed: int, **others: Any) -> "Recording":
        """Return a source as the settings prepare it; ``others`` are the fields that are no settings."""
        own = {name: getattr(settings, name) for name in ("start", "frontend", "tracks", "vary")}
        # What estimators do about biases changes no recording: those that differ in it share one, and its bound.
        noise = msgspec.structs.replace(settings.noise, biases=Noise().biases)
        return cls(source, seed, noise=noise, **own, **others)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A recording as the estimators read it, the findings of the audit in it before, and the state they start from.

    ``recording`` is what it was prepared from, ``whole`` the repaired recording before it was cut, and ``data`` the
    SHA-256 of it and of which part is used; ``undecided`` has the faults that could not be judged, and why;
    ``measured`` is what was measured of its noise, None where the settings state it; ``references`` are the runs of
    other systems.
    """

    recording: Recording
    sequence: Sequence
    findings: tuple[Finding, ...]
    prior: Prior
    whole: Sequence
    data: str
    undecided: Mapping[str, str] = field(default_factory=dict)
    measured: MeasuredNoise | None = None
    card: Card | None = None
    references: tuple[Run, ...] = ()

    @property
    def name(self) -> str:
        return self.sequence.name

    @property
    def source(self) -> str | Sequence:
        return self.recording.source


def prepare(recording: Recording, progress: Progress = SILENT) -> Prepared:
    """Load, audit, cut and find the start, with linear algebra on one thread: the same bits wherever that is done.

    Raises DataError where the source or the truth cannot be used, VislamError where ``keep`` names no fault.
    """
    with on_one_thread():
        return _prepared(recording, audited_recording(recording, progress))


@lru_cache(maxsize=1)
def prepare_once(recording: Recording) -> Prepared:
    """Prepare a recording, or return it where it is the one that was prepared last in this process.

    Its audit is taken from the one before, where that differs by nothing an audit depends on.
    """
    with on_one_thread():
        return _prepared(recording, _audited_once(_for_audit(recording)))


def _for_audit(recording: Recording) -> Recording:
    """Return a recording whose fields that no audit depends on are the defaults."""
    noise, tracks = DEFAULTS.noise, DEFAULTS.tracks
    return replace(recording, noise=noise, tracks=tracks, start="measurements", card=False, faults=None)


@lru_cache(maxsize=1)
def _audited_once(recording: Recording) -> Audit:
    return audited_recording(recording)


@lru_cache(maxsize=1)
def _found_in_part(recording: Recording) -> frozenset[str]:
    return _faults_in(_cut(_audited_once(recording).sequence, recording))


def _faults_in(sequence: Sequence) -> frozenset[str]:
    return frozenset(finding.fault for finding in audit(sequence).findings)


def found_where_planted(recording: Recording, _progress: Progress = SILENT) -> tuple[str, ...]:
    """Return the faults that the audit finds where some are planted in the part that is run, and does not without."""
    with on_one_thread():
        clean = _for_audit(recording)
        part = _cut(_audited_once(clean).sequence, recording)
        return tuple(_faults_in(planted(part, recording.faults or (), recording.seed)) - _found_in_part(clean))


def _prepared(recording: Recording, audited: Audit) -> Prepared:
    whole, requested = audited.sequence, recording
    part = (recording.part, recording.max_frames, recording.duration_s)
    data = hashlib.sha256(f"{whole.content_hash()}{part}".encode()).hexdigest()
    if recording.faults is not None:
        # Where a fault strikes is drawn within the part that is run.
        whole = planted(_cut(whole, recording), recording.faults, recording.seed)
        recording = replace(recording, part=WHOLE, max_frames=None, duration_s=None)
    stated = _with_pixel_noise(whole, recording.noise.pixel_sigma_px)
    if stated is not whole:
        whole, audited = stated, checked_again(audited, "track-scatter", _cut(stated, recording))
    card = None
    if recording.card:
        whole, card = _with_card(whole, _cut(whole, recording))
    whole, measured = _with_measured_noise(whole, recording)
    used = _cut(whole, recording)
    used = with_gap_twists(used) if recording.noise.bridge_gaps else used
    sequence = _within_budget(used, recording.tracks.budget)
    prior = STARTS[recording.start](sequence)
    findings = tuple(_of_part(finding, sequence) for finding in audited.findings)
    return Prepared(requested, sequence, findings, prior, whole, data, audited.undecided, measured, card)


def _of_part(finding: Finding, sequence: Sequence) -> Finding:
    """Return a finding for the part that is run: a warning about other times does not concern its results."""
    first_ns, last_ns = sequence.frames_t_ns[[0, -1]].tolist()
    if not finding.spans_ns or any(begin <= last_ns and end >= first_ns for begin, end in finding.spans_ns):
        return finding
    return replace(finding, warning=False, detail=f"{finding.detail}; none of it is in the part that is run")


def audited_recording(recording: Recording, progress: Progress = SILENT) -> Audit:
    """Load a recording and audit it whole, which shows slow faults (a bias, a lag) better. Raises as :func:`prepare`.

    A simulation of a scenario with ``audited_s`` is audited only over the part that is run, or over a longer part that
    is enough to find what the whole would show. Where something is found there, the whole is audited.
    """
    sequence = _loaded(recording, progress)
    beginning = _to_audit(sequence, recording)
    found = audit(beginning, recording.keep)
    if beginning is sequence:
        return found
    return audit(sequence, recording.keep) if found.findings else replace(found, sequence=sequence)


def _to_audit(sequence: Sequence, recording: Recording) -> Sequence:
    """Return a recording; of a simulation whose scenario says how much is enough, that much or the part that is run."""
    scenario = SCENARIOS.get(recording.source) if isinstance(recording.source, str) else None
    if scenario is None or scenario.audited_s is None:
        return sequence
    t_ns = sequence.frames_t_ns
    end_ns = max(_cut(sequence, recording).frames_t_ns[-1], t_ns[0] + round(scenario.audited_s * NS_PER_S))
    return sequence if end_ns >= t_ns[-1] else sequence.truncated(int((t_ns <= end_ns).sum()))


def recording_card(recording: Recording, progress: Progress = SILENT) -> tuple[Sequence, Card]:
    """Return a recording, audited and cut, and the card of its tracks; no state to start from is looked for.

    Raises as :func:`prepare`, and DataError where the tracks are too few.
    """
    with on_one_thread():
        sequence = _cut(audited_recording(recording, progress).sequence, recording)
        return sequence, card_of(sequence)


def _loaded(recording: Recording, progress: Progress) -> Sequence:
    source = recording.source
    if recording.vary == "world" and source not in SCENARIOS:
        name = source.name if isinstance(source, Sequence) else source
        raise SettingsError(f"{name}: vary=world draws a simulated world ({', '.join(SCENARIOS)}); this is none")
    if isinstance(source, Sequence):
        sequence, wrong = source, why_not_sightings(source)
        if wrong:
            raise DataError(f"{source.name}: {wrong}; correct the sequence (Observations.sorted sorts)")
    elif source in SCENARIOS and is_built_in(source):
        check_built_in(source, recording.frontend)
        scenario = replace(SCENARIOS[source], varied=recording.vary == "world")
        if recording.duration_s is not None:
            scenario = replace(scenario, duration_s=recording.duration_s)
        sequence = told_of_both(simulate(scenario, recording.seed), source)
    else:
        sequence = load_sequence(source, recording.seed, recording.frontend, progress)
    sequence = _with_usable_ids(sequence)
    return sequence if recording.truth is None else with_truth(sequence, *load_truth(recording.truth))


def _with_usable_ids(sequence: Sequence) -> Sequence:
    """Return a sequence whose track ids can be keys of a factor graph, numbered anew where they cannot, as hashes."""
    ids = sequence.observations.track_id
    if not ids.size or (ids.min() >= 0 and ids.max() <= _LARGEST_ID):
        return sequence
    anew = replace(sequence.observations, track_id=np.unique(ids, return_inverse=True)[1])
    fact = f"tracks are numbered anew, in the order of their ids: some of these are not in 0 ... {_LARGEST_ID}"
    return replace(sequence, observations=anew).with_facts(fact)


def _cut(sequence: Sequence, recording: Recording) -> Sequence:
    if recording.duration_s is not None:
        sequence = _first_seconds(sequence, recording.duration_s)
    if recording.part != WHOLE:
        sequence = _part(sequence, recording.part)
    return sequence if recording.max_frames is None else sequence.truncated(recording.max_frames)


def _first_seconds(sequence: Sequence, duration_s: float) -> Sequence:
    end_ns = sequence.frames_t_ns[0] + round(duration_s * NS_PER_S)
    return sequence.truncated(int((sequence.frames_t_ns <= end_ns).sum()))


def _part(sequence: Sequence, part: Part) -> Sequence:
    """Return a part of the frames, recorded in the facts; raises DataError where it has fewer than two."""
    end_s = np.inf if part.to_s is None else part.to_s
    kept = np.flatnonzero((sequence.frames_s >= part.from_s) & (sequence.frames_s <= end_s))[:: part.every]
    if kept.size < 2:
        raise DataError(
            f"{sequence.name}: {part} it has {kept.size} frame(s), and two are needed; it has {sequence.frame_count} "
            f"in {sequence.duration_s:g} s"
        )
    taken = sequence.with_frames(kept).with_facts(f"a part of the recording: {part}")
    return taken if part.every == 1 else _with_truth_at_frames(taken)


def _with_truth_at_frames(sequence: Sequence) -> Sequence:
    """Return a sequence that lacks frames with the truth at those it has, where it has one at each of them.

    Otherwise estimates would be interpolated between frames far apart, and their scores would include that error.
    """
    truth = sequence.truth
    if truth is None or not np.isin(sequence.frames_t_ns, truth.t_ns).all():
        return sequence
    at = np.isin(truth.t_ns, sequence.frames_t_ns)
    v_world, bias = (None if known is None else known[at] for known in (truth.v_world, truth.bias))
    thinned = replace(truth, t_ns=truth.t_ns[at], T_world_imu=truth.T_world_imu[at], v_world=v_world, bias=bias)
    return replace(sequence, truth=thinned)


def _with_pixel_noise(sequence: Sequence, sigma_px: float | None) -> Sequence:
    """Return the sequence with the standard deviation of a column (px) that the settings state, if they do."""
    if sigma_px is None:
        return sequence
    rig = sequence.rig
    return replace(sequence, rig=replace(rig, cov_uv_px2=rig.cov_uv_px2 * (sigma_px**2 / rig.cov_uv_px2[0, 0])))


def _with_measured_noise(sequence: Sequence, recording: Recording) -> tuple[Sequence, MeasuredNoise | None]:
    """Return the sequence with the weight of tracks and the motion's noise that are stated or measured on it.

    Raises DataError where the beginning that is to be measured has no two frames.
    """
    requested, measured = recording.noise, None
    weight, scale = requested.track_weight, requested.motion_scale
    if weight == "auto" or scale == "auto":
        beginning = _to_audit(sequence, recording)
        if requested.measured_s is not None:
            beginning = _first_seconds(beginning, requested.measured_s)
        if beginning.frame_count < 2:
            raise DataError(
                f"{sequence.name}: no two frames are in the first {requested.measured_s:g} s "
                "(noise.measured_s); give it more seconds"
            )
        measured = measured_noise(replace(beginning, rig=replace(sequence.rig, track_weight=1.0)))
        weight = measured.tracks.value if weight == "auto" else weight
        scale = measured.motion.value if scale == "auto" else scale
    noise = sequence.noise if scale == 1.0 else sequence.noise.scaled(scale)
    return replace(sequence, rig=replace(sequence.rig, track_weight=weight), noise=noise), measured


def _within_budget(sequence: Sequence, budget: int | None) -> Sequence:
    """Return the sequence with a budget of tracks a frame for estimators, if there is one, recorded in the facts."""
    if budget is None:
        return sequence
    thinned = replace(sequence, track_budget=budget)
    given = len(thinned.visible) / max(len(sequence.visible), 1)
    if given == 1.0:
        return sequence
    of = f"{given:.0%} of the sightings"
    return thinned.with_facts(f"estimators are given at most {budget} tracks a frame (tracks.budget): {of}")


def _with_card(whole: Sequence, used: Sequence) -> tuple[Sequence, Card | None]:
    try:
        return whole, card_of(used)
    except DataError as error:
        return whole.with_facts(f"no card of its tracks: {str(error).removeprefix(f'{used.name}: ')}"), None
