"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers use ``graph_builder`` (what a packet adds) with ``known_landmarks`` and ``outlier_check``, then
``fixed_lag_tree`` or ``isam2_tree``, both with ``indeterminate``. ``isam2_tree`` also uses ``cached_linearisation``,
``linearisation_error`` (which variables to relinearise) and ``frozen_variables``. With a track noise model they use
``chained_window`` and ``chained_past``. The smart-factor smoother uses ``smart_factors``, ``smart_window`` and
``smart_solver``. Batch uses ``robust_schedule``, whose solves by ``levenberg_marquardt`` are of a ``mixed_graph`` in an
``elimination_order``, then ``track_chain`` with ``landmark_steps``, and ``scale_state``. All use ``robust_loss`` and
``discounted_tracks``, which lowers the weight of tracks whose residuals are correlated.
"""
