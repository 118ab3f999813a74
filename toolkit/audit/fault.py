"""A fault is a check of the evidence, which describes it and returns a repaired sequence."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Self

from toolkit.audit.alignment import ForceBesideCamera, Position, VelocityFit, force_beside_camera, velocity_fit
from toolkit.audit.clocks import TruthClock, truth_clock
from toolkit.audit.intervals import LEAST_INTERVALS, Intervals, compare, is_comparable, usual_step_s
from toolkit.audit.one_step import Agreement, OneStep, agreement, one_step, step_correlation
from toolkit.audit.robust import Scalar
from toolkit.audit.self_calibration import SelfCalibration, self_calibration
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.sequence import Sequence

# Times from and to (ns) at which a fault is there.
Spans = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Finding:
    """One fault found in a recording, as it is reported; ``count`` is in the fault's own unit, named in ``detail``.

    A ``blocking`` one is harmful and not repaired, so that a check of the recording has to fail. A ``warning`` has no
    repair and does not block, but may affect every result. ``spans_ns`` are the times (ns) at which the fault is
    present; it is empty where the fault is present throughout.
    """

    fault: str
    count: int
    repaired: bool
    detail: str
    blocking: bool
    warning: bool = False
    spans_ns: Spans = ()


@dataclass(frozen=True, eq=False)
class Symptom:
    """The result of a check: a count, a description, and the sequence without the fault, None without a sure repair.

    ``treatment`` describes the repair, or why there is none. A symptom that is not ``harmful`` is information. One that
    ``warns`` does not block, but may spoil results: all, or those within its ``spans_ns``. After one that
    ``spoils_vision`` and is not repaired, no later check uses the tracks.
    """

    count: int
    detail: str
    treatment: str
    remedy: Sequence | None
    harmful: bool = True
    warns: bool = False
    spoils_vision: bool = False
    spans_ns: Spans = ()

    @classmethod
    def information(cls, count: int, detail: str, treatment: str) -> Self:
        return cls(count, detail, treatment, remedy=None, harmful=False)

    @classmethod
    def warning(cls, detail: str, treatment: str, count: int = 1, spans_ns: Spans = ()) -> Self:
        return cls(count, detail, treatment, remedy=None, harmful=False, warns=True, spans_ns=spans_ns)


@dataclass(frozen=True)
class Undecided:
    """The result of a check that could not decide, with the reason; a check with nothing to examine returns None."""

    why: str


@dataclass(frozen=True, eq=False)
class Evidence:
    """The sequence at the time a fault is checked, with quantities that several checks derive from it.

    ``spoilt_by`` names a fault that was not repaired and after which the tracks cannot be used; it is empty otherwise.
    """

    sequence: Sequence
    spoilt_by: str = ""

    @cached_property
    def camera_motion(self) -> CameraMotion:
        return camera_motion(self.sequence)

    @cached_property
    def one_step(self) -> OneStep:
        """The residual of each sighting predicted from the previous frame by the camera's own motion."""
        return one_step(self.sequence, self.camera_motion)

    @cached_property
    def step_correlation(self) -> Scalar | None:
        """The correlation of neighbouring one-step residuals; None with too few tracks, or tracks without errors."""
        return step_correlation(self.sequence, self.one_step)

    @cached_property
    def blind(self) -> Undecided:
        """The reason why samples and camera cannot be compared, where ``intervals`` is None."""
        if self.spoilt_by:
            return Undecided(f"{self.spoilt_by} must be corrected before the tracks can be evaluated")
        if not is_comparable(self.sequence):
            return Undecided(
                "the time stamps, or the time span or values of the motion samples, do not allow a comparison "
                "with the camera"
            )
        known, intervals = int(self.camera_motion.known.sum()), max(self.sequence.frame_count - 1, 0)
        if not len(self.sequence.observations):
            return Undecided("there are no sightings to compare with")
        if self.sequence.motion_kind == "none":
            return Undecided("no motion was measured to compare the camera's with")
        per_frame = len(self.sequence.observations) / self.sequence.frame_count
        return Undecided(
            f"the tracks ({per_frame:.1f} sightings a frame) determine the camera's own motion in {known} of "
            f"{intervals} intervals; {LEAST_INTERVALS} are needed"
        )

    @cached_property
    def intervals(self) -> Intervals | None:
        if self.spoilt_by or not is_comparable(self.sequence):
            return None
        return compare(self.sequence, self.camera_motion)

    @cached_property
    def agreement(self) -> Agreement:
        """How well the tracks follow the measured motion; needs ``intervals``."""
        assert self.intervals is not None
        return agreement(self.sequence, self.camera_motion, self.intervals)

    @cached_property
    def velocity_fit(self) -> VelocityFit | None:
        """The camera's scale and pose by the velocities of odometry; None without ``intervals`` or velocities."""
        if self.intervals is None or self.intervals.v_mps is None:
            return None
        step_s = usual_step_s(self.sequence.frames_t_ns)
        return velocity_fit(self.intervals, step_s)

    @cached_property
    def self_calibration(self) -> SelfCalibration | None:
        """The calibration that fits tracks and IMU; None without an IMU, or where it cannot be found."""
        if self.intervals is None or self.sequence.motion_kind != "imu":
            return None
        return self_calibration(self.sequence, self.camera_motion, self.intervals)

    @cached_property
    def position(self) -> Position | None:
        """The camera's position by odometry's velocities, or by the self-calibration with an IMU."""
        found = self.self_calibration if self.sequence.motion_kind == "imu" else self.velocity_fit
        return None if found is None else found.position

    @cached_property
    def force_beside_camera(self) -> ForceBesideCamera:
        """The integrated specific force beside the camera's velocity; needs ``intervals``."""
        assert self.intervals is not None
        return force_beside_camera(self.sequence, self.camera_motion, self.intervals)

    @cached_property
    def truth_clock(self) -> TruthClock | None:
        """Offset and rate of the truth's clock; None without a truth, or where rotations cannot be compared."""
        truth = self.sequence.truth
        if truth is None or self.spoilt_by or not is_comparable(self.sequence):
            return None
        if self.camera_motion.known.sum() < LEAST_INTERVALS:
            return None
        return truth_clock(self.sequence, self.camera_motion, truth)

    def after(self, remedy: Sequence) -> "Evidence":
        """Return the evidence after a repair; quantities from tracks alone are kept if these did not change."""
        now, before = Evidence(remedy, self.spoilt_by), self.sequence
        same_tracks = remedy.observations is before.observations and remedy.frames_t_ns is before.frames_t_ns
        if same_tracks and remedy.rig.baseline_m == before.rig.baseline_m:
            known = ["camera_motion", "one_step", "step_correlation"]
            if remedy.motion is before.motion and remedy.rig is before.rig and remedy.noise is before.noise:
                known += ["intervals", "agreement", "velocity_fit", "self_calibration", "force_beside_camera"]
            now.__dict__.update({name: self.__dict__[name] for name in known if name in self.__dict__})
        return now


Check = Callable[[Evidence], Symptom | Undecided | None]


def beside_camera(check: Callable[[Evidence, Intervals], Symptom | Undecided | None]) -> Check:
    """Make a check of both motions undecided where they cannot be compared."""

    @wraps(check)
    def checked(evidence: Evidence) -> Symptom | Undecided | None:
        return evidence.blind if evidence.intervals is None else check(evidence, evidence.intervals)

    return checked


def name_of(check: Check) -> str:
    return check.__name__.replace("_", "-")
