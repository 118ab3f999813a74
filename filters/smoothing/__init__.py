"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers: ``graph_builder`` (what a packet adds) with ``outlier_check``, then ``fixed_lag_tree`` and
``isam2_tree``, which use ``indeterminate`` and ``cached_linearisation``; with noise of tracks ``chained_window`` and
``chained_past``. Smart factors: ``smart_factors``, ``smart_window``, ``smart_solver``. Batch: ``robust_schedule`` of
solves by ``levenberg_marquardt``, then ``track_chain`` with ``landmark_steps``.
"""
