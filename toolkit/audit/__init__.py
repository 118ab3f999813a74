"""The audit: faults of a recording, found from its data alone, reported and (by default) repaired.

``FAULTS`` lists them in the order in which they are checked. Each is one function of a module named after its kind:
``timing``, ``tracks``, ``samples``, ``conventions``, ``calibration``, ``agreement`` (of vision with the motion) or
``truth``. To add one, write the function there and a line of the list. Read ``fault`` first, then
``tracks.no_disparity``, the smallest, and ``tracks.stale_frames`` and ``conventions.mixed_axes``, which repair.

The kinds share ``intervals`` (both motions from frame to frame), ``one_step`` (residuals of the tracks),
``alignment`` (a regression of the camera's translation), ``self_calibration`` (an adjustment), ``clocks`` and
``robust`` (statistics).

Faults report values that are impossible, so that NumPy's warnings about them are not shown.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from toolkit.audit import agreement, calibration, conventions, samples, timing, tracks, truth
from toolkit.audit.fault import Check, Evidence, Finding, Symptom, Undecided, name_of
from toolkit.errors import UnknownNameError, no_such
from toolkit.sequence import Sequence

__all__ = ["FAULTS", "Audit", "Finding", "audit", "checked_again", "faults"]

# In the order in which they are checked, each after those whose repairs it needs.
FAULTS: dict[Check, str] = {
    timing.clock_jump: "a clock that is set during the recording, while the vehicle moves on",
    tracks.no_sightings: "frames none of which has a sighting, in a recording with a camera",
    tracks.unknown_rows: "rows of left and right image that may differ, in a file with one for both",
    timing.time_order: "time stamps that repeat, run backwards, jump back or are no time at all",
    tracks.returning_tracks: "track ids that are absent for some frames and then come back",
    tracks.stale_frames: "frames whose tracks repeat the previous frame's pixels exactly while the vehicle moves",
    samples.not_finite: "sightings or motion samples that hold NaN or infinity",
    samples.implausible: "single sightings or motion samples beyond the range of any sensor",
    samples.stuck_samples: "an accelerometer, a gyro or odometry that repeats one value",
    tracks.coarse_pixels: "sightings rounded to whole pixels or parts of one",
    timing.outside_motion: "frames before the first or after the last motion sample",
    samples.saturated_samples: "an accelerometer or a gyro that is saturated",
    tracks.swapped_coordinates: "left and right images, or rows and columns, exchanged",
    timing.time_gap: "holes in the motion samples or in the frames",
    tracks.doubled_disparity: "tracks whose disparity doubles from their first sighting to the second",
    tracks.no_disparity: "stereo sightings with a disparity uL - uR <= 0",
    timing.sparse_motion: "motion samples that come more rarely than frames",
    calibration.intrinsics: "a principal point or a focal length that is inconsistent with the sightings",
    tracks.left_only: "sightings that lack the right image",
    samples.exchanged_samples: "velocities, or accelerations, exchanged with rates of rotation",
    timing.uneven_stamps: "frames whose stamps are uneven although the images were taken evenly",
    samples.gravity_removed: "an accelerometer whose driver took gravity out of what it measures",
    samples.units: "times, lengths, speeds, rates of rotation or accelerations in another unit than SI",
    samples.coarse_samples: "quantised motion samples, whose rounding is a considerable part of the stated noise",
    conventions.extrinsic_convention: "an extrinsic whose direction and camera axes the file's format leaves open",
    samples.overstated_noise: "an IMU whose stated noise is far larger than that of its samples",
    samples.understated_noise: "an IMU whose samples scatter far more than the stated noise, even where they are quiet",
    tracks.thin_vision: "too few tracks to determine the camera's motion, for half a second or more",
    tracks.track_scatter: "tracks that scatter more than the stated noise explains (mismatches), or far less",
    conventions.mixed_axes: "motion samples and camera extrinsic in different axes, or an inverted extrinsic",
    timing.motion_gap: "short gaps in the motion samples",
    conventions.extrinsic_translation: "an extrinsic whose translation is that of its inverse",
    timing.twist_lag: "twist samples that describe another interval than the one they are paired with",
    timing.time_offset: "frames and motion samples stamped by different clocks",
    conventions.accelerometer_axes: "an accelerometer whose channels are exchanged or have the wrong sign",
    timing.clock_change: "clocks of frames and motion samples that drift apart during the recording",
    agreement.disagreement: "tracks that contradict the measured motion for a reason that no other fault explains",
    calibration.gyro_bias: "a constant gyro bias",
    agreement.image_jump: "an image that jumps, permanently, while the vehicle does not",
    truth.gravity_direction: "gravity whose direction in the truth's world differs from the IMU's",
    calibration.gyro_scale: "an axis of the gyro that measures faster or slower rotation than the camera",
    calibration.lever_arm: "a position of the camera that differs from the extrinsic's, by residuals in turns",
    calibration.miscalibration: "a camera rotated slightly against its extrinsic, or a slight error of scale",
    agreement.scale_change: "odometry whose scale relative to the camera changes during the recording",
    calibration.steady_difference: "vision and odometry that differ throughout, by no more than slip causes",
    truth.truth_clock: "a truth by a clock that runs faster or slower than the frames'",
    truth.truth_mismatch: "a truth that moves unlike vision: another motion or unit, a wrong baseline",
    calibration.vision_scale: "steps of vision that are a few percent longer or shorter than the measured ones",
    agreement.accelerometer_change: "an accelerometer that reads another gravity from some time on",
    agreement.conflict: "vision and the measured motion disagree for seconds: moving objects or wrong samples",
}

# Largest share of the sightings that a repair may drop; beyond it the finding blocks. Sightings of frames that the
# repair cuts off are not counted.
MOST_LOST = 0.2


@dataclass(frozen=True, eq=False)
class Audit:
    """The sequence after the audit's repairs, and the findings in the order in which faults are checked.

    ``undecided`` names the faults that could not be decided from the recording, with the reason.
    """

    sequence: Sequence
    findings: tuple[Finding, ...]
    undecided: Mapping[str, str] = field(default_factory=dict)


@np.errstate(all="ignore")
def audit(sequence: Sequence, keep: frozenset[str] = frozenset()) -> Audit:
    """Check every fault in turn and repair it, unless its name is in ``keep``; each sees the repairs before it.

    Raises UnknownNameError where ``keep`` names a fault that does not exist.
    """
    unknown = keep - faults().keys()
    if unknown:
        raise UnknownNameError(no_such("fault", min(unknown), faults()))
    evidence, findings, undecided = Evidence(sequence), [], {}
    for fault in FAULTS:
        name, symptom = name_of(fault), fault(evidence)
        if isinstance(symptom, Undecided):
            undecided[name] = symptom.why
        elif symptom is not None:
            remedy = None if name in keep else symptom.remedy
            findings.append(_finding(name, symptom, evidence.sequence, repaired=remedy is not None))
            if remedy is not None:
                evidence = evidence.after(remedy)
            elif symptom.spoils_vision:
                evidence = Evidence(evidence.sequence, name)
    return Audit(evidence.sequence, tuple(findings), undecided)


@np.errstate(all="ignore")
def checked_again(found: Audit, name: str, sequence: Sequence) -> Audit:
    """Return an audit with one fault, which must have no repair, checked again in a changed recording."""
    fault = next(fault for fault in FAULTS if name_of(fault) == name)
    findings = tuple(finding for finding in found.findings if finding.fault != name)
    undecided = {key: why for key, why in found.undecided.items() if key != name}
    symptom = fault(Evidence(sequence))
    if isinstance(symptom, Undecided):
        undecided[name] = symptom.why
    elif symptom is not None:
        findings = (*findings, _finding(name, symptom, sequence, repaired=False))
    return replace(found, findings=findings, undecided=undecided)


def faults() -> dict[str, str]:
    """Return the name and a one-line summary of every fault the audit knows, in the order they are checked."""
    return {name_of(fault): summary for fault, summary in FAULTS.items()}


def _finding(name: str, symptom: Symptom, before: Sequence, repaired: bool) -> Finding:
    left_alone = symptom.remedy is not None and not repaired
    detail = f"{symptom.detail}; {'left as it is' if left_alone else symptom.treatment}"
    lost = _share_lost(before, symptom.remedy) if repaired and symptom.remedy is not None else 0.0
    if symptom.harmful and lost > MOST_LOST:
        detail += f"; it takes {lost:.0%} of the sightings, with which the recording is another one"
    blocking = symptom.harmful and (not repaired or lost > MOST_LOST)
    return Finding(name, symptom.count, repaired, detail, blocking, symptom.warns, symptom.spans_ns)


def _share_lost(before: Sequence, after: Sequence) -> float:
    in_kept_frames = np.isin(before.frames_t_ns, after.frames_t_ns)[before.observations.frame].sum()
    return 1.0 - len(after.observations) / int(in_kept_frames) if in_kept_frames else 0.0
