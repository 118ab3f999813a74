"""Measurement and motion models that filters and smoothers share, each fact once: arrays in, arrays and Jacobians out.

Read ``stereo`` (the measurement, linearised) with ``left_only`` (where the right image is missing), ``state`` (layout,
belief, prediction), ``motion`` (what a motion model offers filters and graphs) with its implementations ``twist``,
``imu`` and ``smooth_twist`` (nothing measured), then ``factors`` (keys, stereo factors, priors, marginals),
``stacked_factors`` (Python factors of one form, evaluated at once), ``state_covariances`` (of all states of a graph),
``gating`` (thresholds and their sources) and ``noise`` (for files that state none).

For a window that eliminates its landmarks: ``stereo_window``, ``reduced_vision``, ``window_solver``. From the tracks
alone: ``camera_motion``. What moves against the motion: ``moving_tracks``. To judge an estimate:
``corrections`` (its steps beside the measured motion, tested against the covariance that they removed).
"""
