"""Parts of the handwritten filters, in NumPy; GTSAM only preintegrates IMU samples, inside the shared models.

Decoupled filters: ``landmark_map`` (one small Gaussian a landmark), ``correction``, ``frame_gate``.
Joint filters: ``joint`` (the belief and its covariance), ``linearisation``, ``joint_landmarks``, ``joint_ekf``; then
``inverse_depth`` for ekf-slam, ``invariant`` for riekf and iekf; ``multiview``, ``triangulation``, ``track_gate``,
``tracks_in_view`` and ``sliding_window`` for the MSCKFs. ``kernels`` has what is compiled, ``compiled`` puts it in the
place of its definition in NumPy. ``online_output`` makes an estimator of each; ``thinning`` gives one with a window,
filter or smoother, no more frames than the window may hold.
"""
