"""Parts of the handwritten filters, in NumPy; GTSAM only preintegrates IMU samples, inside the shared models.

Decoupled filters: ``landmark_map`` (one small Gaussian a landmark), ``correction``, ``gate``.
Joint filters: ``joint`` (the belief and its covariance), ``linearisation``, ``joint_landmarks``, ``joint_ekf``; then
``inverse_depth`` for ekf-slam, ``invariant`` and ``iterated`` for riekf and iekf, ``multiview``, ``triangulation``,
``track_gate``, ``tracks_in_view`` and ``sliding_window`` for the MSCKFs; ``kernels`` has gate and tracks in view
compiled, ``compiled_gate`` and ``compiled_in_view`` call it. ``online_output`` makes an estimator of each; ``thinning``
gives one with a window, filter or smoother, no more frames than the window may hold.
"""
