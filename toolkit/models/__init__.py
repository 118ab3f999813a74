"""Measurement and motion models that filters and smoothers share, each fact once: arrays in, arrays and Jacobians out.

Read ``stereo`` (the measurement, linearised), ``state`` (layout, belief, prediction), ``motion`` (what a motion model
offers filters and graphs) with its implementations ``twist`` and ``imu``, then ``factors`` (keys, stereo factors,
priors, marginals), ``state_covariances`` (of all states of a graph), ``gating`` (thresholds and their sources) and
``noise`` (for files that state none).
"""
