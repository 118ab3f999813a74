"""Measurement and motion models that filters and smoothers share: arrays in, arrays and Jacobians out.

Read ``stereo`` (the measurement, linearised, with or without the right image), ``state`` (layout, belief, prediction,
and what a motion model offers filters), ``motion`` (the model of a recording) with its implementations ``twist`` and
``imu``, then ``factors`` (keys, stereo factors, priors, marginals), ``graph_state`` (what a motion model offers
graphs), ``state_covariances`` (of all states of a graph), ``gating`` (thresholds and their sources) and ``noise`` (for
files that state none).

States adjusted to stereo tracks whose landmarks are eliminated: ``stereo_adjustment``. From the tracks alone:
``camera_motion``. To judge an estimate: ``corrections`` (its steps beside the measured motion, and its corrections
tested against the covariance they take away).
"""
