"""Faults of the motion samples: values that no sensor gives, wrong units, axes, scales, biases and noise.

Read ``not_finite`` and ``implausible`` for single values; ``stuck_samples``, ``saturated_samples`` and
``coarse_samples`` for faults of a sensor or its driver; ``units`` and ``exchanged_samples`` for columns;
``overstated_noise`` for the stated noise; then the faults that the camera's motion shows: ``accelerometer_axes``,
``accelerometer_change``, ``gyro_bias`` and ``gyro_scale``.
"""
