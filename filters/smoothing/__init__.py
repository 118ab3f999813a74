"""Parts of the GTSAM smoothers; motion and stereo factors come from the shared models.

Incremental smoothers use ``graph_builder`` (what a packet adds) with ``outlier_check``, then ``fixed_lag_tree`` or
``isam2_tree``, both with ``indeterminate``. Batch solves by ``levenberg_marquardt`` in an ``elimination_order``. The
window of ``smart`` and ``sliding_window`` is :mod:`toolkit.models.stereo_adjustment`, because the measurement of noise
uses it, too.
"""
