"""The input: one recording as immutable values, and the packets every estimator reads from it.

Observations are sparse, one row a sighting. Motion samples are cut at the frame times once, in
:meth:`Sequence.packets`, so that every estimator integrates the same interval; one track in ten is withheld
from all of them and serves the held-out reprojection error.
"""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from toolkit.arrays import freeze_arrays
from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import (
    GRAVITY_WORLD,
    NS_PER_S,
    Motion,
    MotionKind,
    MotionNoise,
    Packet,
    Prior,
    StereoFrame,
    StereoRig,
    is_measured,
)
from toolkit.motion_samples import Bridges, GapTwists, MotionSamples, are_of_one_kind, kind_of, motions_between
from toolkit.track_budget import parts_of_view, within_budget

HELD_OUT_ONE_IN = 10
# The fact stating that the recording has no tracks.
NO_FEATURES = "no image features in this file"
# The fact stating that the extrinsic may be inverted, or in camera axes x forward, y left, z up.
EXTRINSIC_UNCERTAIN = "the extrinsic's direction and camera axes are not certain in this format"
# The fact stating that the recording gives one image row for both images of a sighting.
ONE_ROW_FOR_BOTH = "one row v stands for both images of a sighting in this file"
# Longest name of a recording or a trajectory: it becomes part of file names, for which systems allow 255 bytes.
LONGEST_NAME = 200


@dataclass(frozen=True, eq=False)
class Observations:
    """Stereo sightings sorted by frame then track: frame index (N,), track id (N,), (uL, uR, v) (N, 3) px.

    uR is NaN in a sighting by the left image alone (:func:`is_left_only`).
    """

    frame: IntArray
    track_id: IntArray
    uv_px: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, frame=(None,), track_id=(None,), uv_px=(None, 3))

    def __len__(self) -> int:
        return self.frame.size

    def select(self, rows: BoolArray | IntArray) -> "Observations":
        """Return the rows of a mask (N,) or the rows of an index (M,), in that order."""
        return Observations(self.frame[rows], self.track_id[rows], self.uv_px[rows])

    @property
    def by_track(self) -> IntArray:
        """The order (N,) that lists the sightings track by track, each track by frame."""
        return np.lexsort((self.frame, self.track_id))

    def split(self, starts: BoolArray) -> IntArray:
        """Return track ids (N,) in which a new track begins at every row of the mask ``starts`` (N,).

        The first part of each track keeps its id; new ids follow the largest one there is.
        """
        order = self.by_track
        track_id = self.track_id[order]
        first_of_track = np.diff(track_id, prepend=-1) != 0
        first_of_track[:1] = True
        part = np.cumsum(starts[order] & ~first_of_track)
        part_at_first = np.maximum.accumulate(np.where(first_of_track, part, 0))
        renamed = np.empty_like(track_id)
        renamed[order] = np.where(part > part_at_first, track_id.max(initial=-1) + part, track_id)
        return renamed

    @classmethod
    def sorted(cls, frame: IntArray, track_id: IntArray, uv_px: Array) -> "Observations":
        """Build from frames (N,), track ids (N,) and sightings (N, 3) px in any order."""
        order = np.lexsort((track_id, frame))
        return cls(frame[order], track_id[order], uv_px[order])


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth on its own stamps (N,): poses (N, 4, 4) and, where known, velocities (N, 3), biases (N, 6).

    ``independent`` is False where the truth and the motion samples come from the same instrument, so that
    agreement with them proves nothing about consistency.
    """

    t_ns: IntArray
    T_world_imu: Array
    v_world: Array | None = None
    bias: Array | None = None
    independent: bool = True

    def __post_init__(self) -> None:
        freeze_arrays(self, t_ns=(None,), T_world_imu=(None, 4, 4), v_world=(None, 3), bias=(None, 6))


@dataclass(frozen=True)
class Provenance:
    """Where a sequence comes from: its format, its source, and facts a reader of any result must know."""

    format: str
    source: str
    facts: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Sequence:
    """One recording: calibration, noise, frame stamps (K,), sightings, motion samples, and truth if there is any.

    A sequence may still carry the faults of its file (see :mod:`toolkit.audit`); only :meth:`packets` insists on finite
    values and increasing time. ``gravity_world`` (3,) m/s^2; ``bridges``: where motion samples are interpolated;
    ``gap_twists``: the motion of intervals that no track leads across, where it is better known than by the samples;
    ``track_budget``: the most tracks a frame that estimators are given, None for all.
    """

    name: str
    rig: StereoRig
    noise: MotionNoise
    frames_t_ns: IntArray
    observations: Observations
    motion: MotionSamples
    provenance: Provenance
    gravity_world: Array = field(default_factory=lambda: np.array(GRAVITY_WORLD))
    prior: Prior | None = None
    truth: Truth | None = None
    bridges: Bridges | None = None
    gap_twists: GapTwists | None = None
    track_budget: int | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self, frames_t_ns=(None,), gravity_world=(3,))
        if not are_of_one_kind(self.motion, self.noise):
            raise DataError(f"{self.name}: the motion noise is not of the kind of the motion samples")

    @property
    def motion_kind(self) -> MotionKind:
        return kind_of(self.motion)

    @property
    def frame_count(self) -> int:
        return self.frames_t_ns.size

    @property
    def duration_s(self) -> float:
        return float(self.frames_t_ns[-1] - self.frames_t_ns[0]) / NS_PER_S if self.frame_count else 0.0

    @property
    def frames_s(self) -> Array:
        """Return the frames' times (K,) in seconds from the first."""
        return self.elapsed_s(self.frames_t_ns)

    def elapsed_s(self, t_ns: IntArray) -> Array:
        """Return stamps (N,) in seconds from the first frame."""
        return np.asarray((t_ns - self.frames_t_ns[:1]) / NS_PER_S)

    @cached_property
    def held_out(self) -> Observations:
        """The sightings of the tracks no estimator ever sees."""
        return self.observations.select(is_held_out(self.observations.track_id))

    @cached_property
    def visible(self) -> Observations:
        """The sightings (N,) the estimators work on."""
        seen = self.observations.select(~is_held_out(self.observations.track_id))
        if self.track_budget is None:
            return seen
        parts = parts_of_view(seen.uv_px, (self.rig.cx_px, self.rig.cy_px), self.track_budget)
        _, first, track = np.unique(seen.track_id, return_index=True, return_inverse=True)
        ages = seen.frame - seen.frame[first][track]
        given = within_budget(self.track_budget, self._frame_starts(seen), seen.track_id, ages, parts)
        return seen.select(given)

    def _frame_starts(self, seen: Observations) -> IntArray:
        """Return the row (K + 1,) at which the sightings of each frame begin, and where those of the last end."""
        return np.searchsorted(seen.frame, np.arange(self.frame_count + 1))

    def packets(self) -> Iterator[Packet]:
        """Yield one packet a frame, in order of time.

        Raises DataError where time does not increase, a value is not finite, or frames lie outside the
        motion samples.
        """
        motions, seen = self.motions(), self.visible
        first_row = self._frame_starts(seen)
        for k in range(self.frame_count):
            rows = slice(first_row[k], first_row[k + 1])
            frame = StereoFrame(int(self.frames_t_ns[k]), seen.track_id[rows], seen.uv_px[rows])
            yield Packet(k, next(motions) if k else None, frame)

    def motions(self) -> Iterator[Motion]:
        """Return the motion of each interval between frames, in order of time; raise as :meth:`packets` does."""
        _ = self._is_runnable
        return motions_between(self.motion, self.frames_t_ns, self.bridges, self.gap_twists)

    @cached_property
    def _is_runnable(self) -> bool:
        check_runnable(self)  # once: its arrays are read-only
        return True

    def truncated(self, max_frames: int) -> Self:
        """Return the first frames of the sequence only; the motion samples stay whole."""
        if max_frames < 0:
            raise DataError(f"{self.name}: it has no {max_frames} frames; give the number of those to keep")
        if max_frames >= self.frame_count:
            return self
        kept = self.observations.select(self.observations.frame < max_frames)
        return replace(self, frames_t_ns=self.frames_t_ns[:max_frames], observations=kept)

    def with_facts(self, *facts: str) -> Self:
        """Return the sequence with more facts that a reader of its results must know."""
        return replace(self, provenance=replace(self.provenance, facts=(*self.provenance.facts, *facts)))

    def with_frames(self, kept: IntArray) -> Self:
        """Return the sequence with the frames ``kept`` (M,), in that order, without the sightings of the others.

        A prior is the state at the first frame: it is dropped where the first frame changes.
        """
        new_index = np.full(self.frame_count, -1)
        new_index[kept] = np.arange(kept.size)
        seen = self.observations.select(new_index[self.observations.frame] >= 0)
        observations = Observations.sorted(new_index[seen.frame], seen.track_id, seen.uv_px)
        prior = self.prior if kept.size > 0 and kept[0] == 0 else None
        return replace(self, frames_t_ns=self.frames_t_ns[kept], observations=observations, prior=prior)

    def with_samples(self, kept: BoolArray | IntArray) -> Self:
        """Return the sequence with the motion samples of a mask (S,) or an index (M,), in that order."""
        return replace(self, motion=self.motion.of(self.motion.t_ns[kept], self.motion.values[kept]))

    def content_hash(self, digits: int | None = None) -> str:
        """Return a SHA-256 over everything an estimator can see and the truth it is scored on.

        With ``digits``, of the same rounded (:func:`content_digest`).
        """
        rig = [getattr(self.rig, each.name) for each in fields(self.rig)]
        # A weight of 1 does not change a hash: baselines of before there was one stay comparable.
        rig[-1] = None if self.rig.track_weight == 1.0 else self.rig.track_weight
        seen = (self.frames_t_ns, self.gravity_world, *rig, self.noise, self.observations, self.motion)
        further = filter(None, (self.bridges, self.gap_twists, self.track_budget))
        return content_digest((*seen, self.truth, self.prior, *further), digits)


def is_held_out(track_ids: IntArray) -> BoolArray:
    """Say for each track id (N,) whether it is withheld: one in ten, by a fixed multiplicative hash."""
    mixed = track_ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return np.asarray((mixed >> np.uint64(33)) % np.uint64(HELD_OUT_ONE_IN) == 0)


def check_runnable(sequence: Sequence) -> None:
    """Raise DataError unless time increases, values are finite and the motion samples span the frames."""
    name, motion = sequence.name, sequence.motion
    check_stated(sequence)
    if sequence.frame_count < 2:
        raise DataError(f"{name}: {sequence.frame_count} frame(s); an estimator needs at least two")
    for what, t_ns in (("frame", sequence.frames_t_ns), ("motion sample", motion.t_ns)):
        backwards = np.flatnonzero(np.diff(t_ns) <= 0)
        if backwards.size:
            raise DataError(
                f"{name}: the stamp of {what} {backwards[0] + 1} is not after the one before it; "
                "correct the stamps; 'vislam check-data' says what is wrong with all of them"
            )
    samples, sightings = np.isfinite(motion.values).all(axis=1), is_measured(sequence.observations.uv_px)
    for what, sound in (("motion sample", samples), ("observation", sightings)):
        bad = np.flatnonzero(~sound)
        if bad.size and bad.size == sound.size:
            raise DataError(f"{name}: none of its {bad.size} {what}s is finite: check the program that wrote them")
        if bad.size:
            raise DataError(f"{name}: {what} {bad[0]} is not finite ({bad.size} such rows); drop it from the recording")
    first, last = sequence.frames_t_ns[[0, -1]]
    if motion.t_ns.size == 0:
        raise DataError(f"{name}: it has no motion samples; estimators need some")
    if motion.t_ns[0] > first or motion.t_ns[-1] < last:
        raise DataError(f"{name}: the motion samples do not span the frames; cut the frames to the motion's time")


def why_not_sightings(sequence: Sequence) -> str:
    """Return why the observations cannot be sightings of the sequence's frames; empty where they can."""
    seen = sequence.observations
    if not len(seen) == seen.track_id.size == len(seen.uv_px):
        return "the observations' columns differ in length"
    if (np.diff(seen.frame) < 0).any():
        return "the observations are not sorted by frame"
    outside = np.flatnonzero((seen.frame < 0) | (seen.frame >= sequence.frame_count))
    if outside.size:
        return f"observation {outside[0]} is of frame {seen.frame[outside[0]]}, there are {sequence.frame_count}"
    return ""


def check_stated(sequence: Sequence) -> None:
    """Raise DataError, which names the field, where a noise, a calibration or a name is not valid."""
    if len(sequence.name) > LONGEST_NAME:
        raise DataError(f"a name of {len(sequence.name)} characters is too long for a recording; shorten it")
    rig = sequence.rig
    positive: dict[str, Array | float] = {f"noise.{key}": value for key, value in vars(sequence.noise).items()}
    positive |= {f"rig.{key}": getattr(rig, key) for key in ("fx_px", "fy_px", "baseline_m")}
    for key, value in positive.items():
        smallest = float(np.min(value))
        if not (smallest > 0.0 and np.isfinite(value).all()):
            raise DataError(
                f"{sequence.name}: {key} is {smallest:g}, expected a positive number; correct the recording"
            )
    centre = np.array([rig.cx_px, rig.cy_px])
    fixed = {"rig.cx_px or cy_px": centre, "rig.T_imu_cam": rig.T_imu_cam, "gravity_world": sequence.gravity_world}
    for key, value in fixed.items():
        if not np.isfinite(value).all():
            raise DataError(f"{sequence.name}: {key} is not finite; a calibration needs every value")
    if not (np.isfinite(rig.cov_uv_px2).all() and (np.linalg.eigvalsh(rig.cov_uv_px2) > 0.0).all()):
        raise DataError(f"{sequence.name}: rig.cov_uv_px2 is no covariance: its noise must be positive in every axis")


def content_digest(values: Iterable[object], digits: int | None = None) -> str:
    """Return the SHA-256, in hexadecimal digits, over arrays, numbers, texts and the fields of dataclasses.

    With ``digits``, floats are rounded first: a number to that many significant digits, an array to that many digits of
    its largest value. The shape of every array is part of the digest.
    """
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value, digits)
    return digest.hexdigest()


def _feed(digest: "hashlib._Hash", value: object, digits: int | None) -> None:
    if isinstance(value, np.ndarray):
        counted = value if digits is None or value.dtype.kind != "f" else _rounded(value, digits)
        digest.update(str(value.shape).encode())
        digest.update(np.ascontiguousarray(counted).data)
    elif is_dataclass(value):
        for field in fields(value):
            _feed(digest, getattr(value, field.name), digits)
    elif digits is not None and isinstance(value, float):
        digest.update(f"{value:.{digits}g}".encode())
    else:
        digest.update(repr(value).encode())


def _rounded(array: Array, digits: int) -> Array:
    """Return an array rounded to ``digits`` digits of its largest value; -0.0, whose bits are others, becomes 0."""
    finite = np.abs(array[np.isfinite(array)])
    largest = float(finite.max()) if finite.size else 0.0
    if largest == 0.0:
        return array + 0.0
    return np.round(array, digits - 1 - int(np.floor(np.log10(largest)))) + 0.0
