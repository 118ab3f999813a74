"""Faults to plant in a recording: what goes wrong with trackers, motion sensors, clocks, calibrations and units.

Every injector is ``fault(sequence, dose, seed) -> Sequence``: it leaves what it is given as it is, draws where and
whom it strikes from the seed, and can be followed by another. The dose is in the unit its docstring names. The truth
stays that of the motion, unless the fault is one of the truth. All are reached from here; read ``tracks``, ``motion``,
``clocks``, ``standstill``, ``calibration`` and ``truth``, which share ``parts``.
"""

from collections.abc import Callable

from toolkit.sequence import Sequence
from toolkit.simulation.faults.calibration import (
    baseline_unit,
    displaced_camera,
    extrinsic_unit,
    identity_intrinsics,
    inverted_extrinsic,
    negative_focal,
    shifted_centre,
    skewed_pixels,
    transposed_intrinsics,
    turned_camera,
    wrong_aspect,
    wrong_focal_length,
    zero_intrinsics,
)
from toolkit.simulation.faults.clocks import (
    alternate_frames_late,
    camera_clock,
    camera_clock_drift,
    camera_clock_step,
    clock_jump,
    frame_jitter,
)
from toolkit.simulation.faults.motion import (
    angular_unit,
    changed_speed,
    coarse_samples,
    disturbed_motion,
    gyro_axis_scale,
    gyro_bias,
    linear_unit,
    motion_gap,
    nan_span,
    saturated_motion,
    spike,
    stuck_motion,
    thinned_motion,
    wrong_noise,
)
from toolkit.simulation.faults.standstill import standstill
from toolkit.simulation.faults.tracks import (
    blackout,
    dropped_sightings,
    exchanged_tracks,
    few_tracks,
    jumped_image,
    misaligned_rows,
    missing_right,
    moving_objects,
    one_sided_view,
    outlier_tracks,
    rolled_right,
    shifted_pixels,
    shifted_right,
    stretched_disparity,
    swapped_coordinates,
    swapped_images,
)
from toolkit.simulation.faults.truth import truth_clock_rate, truth_unit, unwritten_orientations

Fault = Callable[[Sequence, float, int], Sequence]

__all__ = [
    "Fault",
    "alternate_frames_late",
    "angular_unit",
    "baseline_unit",
    "blackout",
    "camera_clock",
    "camera_clock_drift",
    "camera_clock_step",
    "changed_speed",
    "clock_jump",
    "coarse_samples",
    "displaced_camera",
    "disturbed_motion",
    "dropped_sightings",
    "exchanged_tracks",
    "extrinsic_unit",
    "few_tracks",
    "frame_jitter",
    "gyro_axis_scale",
    "gyro_bias",
    "identity_intrinsics",
    "inverted_extrinsic",
    "jumped_image",
    "linear_unit",
    "misaligned_rows",
    "missing_right",
    "motion_gap",
    "moving_objects",
    "nan_span",
    "negative_focal",
    "one_sided_view",
    "outlier_tracks",
    "rolled_right",
    "saturated_motion",
    "shifted_centre",
    "shifted_pixels",
    "shifted_right",
    "skewed_pixels",
    "spike",
    "standstill",
    "stretched_disparity",
    "stuck_motion",
    "swapped_coordinates",
    "swapped_images",
    "thinned_motion",
    "transposed_intrinsics",
    "truth_clock_rate",
    "truth_unit",
    "turned_camera",
    "unwritten_orientations",
    "wrong_aspect",
    "wrong_focal_length",
    "wrong_noise",
    "zero_intrinsics",
]
