"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers: ``graph_builder`` (what a packet adds) with ``outlier_check`` and ``known_landmarks``, then
``fixed_lag_tree`` and ``isam2_tree`` with ``indeterminate``; ``isam2_tree`` also with ``cached_linearisation``,
``linearisation_error`` (what is linearised anew) and ``frozen_variables``. With noise of tracks ``chained_window`` and
``chained_past``. Smart factors: ``smart_factors``, ``smart_window``, ``smart_solver``. Batch: ``robust_schedule`` of
solves by ``levenberg_marquardt`` of a ``mixed_graph``, in an ``elimination_order``, then ``track_chain`` with
``landmark_steps``, and ``scale_state``. Both: ``robust_loss``, and ``discounted_tracks``, which count for less where
their residuals are correlated.
"""
