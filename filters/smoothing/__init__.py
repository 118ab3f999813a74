"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers: ``graph_builder`` (what a packet adds) with ``outlier_check``, then ``fixed_lag_tree`` and
``isam2_tree``, which use ``indeterminate`` and ``cached_linearisation``. Smart factors: ``smart_factors``,
``smart_window``, ``smart_solver``. Batch: ``robust``, ``levenberg_marquardt``.
"""
