"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers use ``graph_builder`` (what a packet adds) with ``known_landmarks`` and ``outlier_check``, then
``fixed_lag_tree`` or ``isam2_tree``, both with ``indeterminate``. ``isam2_tree`` also uses ``cached_linearisation``,
``linearisation_error`` (which variables to relinearise) and ``frozen_variables``. Batch solves a
``mixed_graph`` by ``levenberg_marquardt`` in an ``elimination_order``, with ``landmark_steps``. The smart-factor
smoother's window is in :mod:`toolkit.models`, because the measurement of noise uses it, too.
"""
