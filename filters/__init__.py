"""The estimators, side by side: a file is an estimator and reads like its algorithm, a folder holds parts.

Read ``dead_reckoning``, ``ekf``, ``msckf_slam`` and ``batch``, which are compared by default; then up the ladder by
``RUNG``: the handwritten filters with ``kalman``, the GTSAM smoothers with ``smoothing``. No estimator imports another.
"""
