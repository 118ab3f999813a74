"""Faults of the calibration: fields of the cameras and of the extrinsic that the data contradict.

Read ``intrinsics`` (values that the sightings alone rule out), ``extrinsic_convention`` and ``extrinsic_translation``
(what formats leave open), ``mixed_axes`` (axes of the samples and of the extrinsic), then the small errors that a
self-calibration finds: ``miscalibration`` and ``lever_arm``.
"""
