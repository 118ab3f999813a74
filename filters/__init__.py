"""The estimators, side by side: a file is an estimator and holds its algorithm, a folder holds parts.

Read ``dead_reckoning``, ``ekf``, ``msckf_slam`` and ``batch``, which are compared by default; then up the ladder by
``RUNG``: the handwritten filters with ``kalman``, the GTSAM smoothers with ``smoothing``. An estimator
imports another only where it is an option of it, or starts from it.
"""
