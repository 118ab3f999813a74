"""Faults of the motion samples: values that no sensor gives, wrong units, axes, scales, biases and noise.

Read ``not_finite`` and ``implausible`` for single values; ``stuck_samples``, ``saturated_samples`` and
``coarse_samples`` for what a sensor's electronics do; ``units`` and ``exchanged_samples`` for columns; then what
vision tells of a sensor: ``accelerometer_axes``, ``accelerometer_change``, ``gyro_bias``, ``gyro_scale``,
``overstated_noise``.
"""
