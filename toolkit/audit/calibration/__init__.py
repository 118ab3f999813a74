"""Faults of the calibration: fields of the cameras and of the extrinsic that the data contradict.

Read ``intrinsics`` (fields that the sightings themselves rule out), ``extrinsic_convention`` and
``extrinsic_translation`` (what formats leave open), ``mixed_axes`` (beside the motion), then what needs an adjustment:
``miscalibration`` and ``lever_arm``.
"""
