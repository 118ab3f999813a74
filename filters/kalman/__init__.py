"""Parts of the handwritten filters, in NumPy but for the MSCKFs' tracks; GTSAM only preintegrates IMU samples.

Decoupled filters: ``landmark_map`` (one small Gaussian a landmark, and its correction). Joint filters:
``joint`` (the belief, its covariance, where it is linearised, how landmarks correct it), and ``coordinates``, the other
errors of ekf-slam, riekf, iekf and of anchored landmarks; ``tracks`` for the MSCKFs, with what is compiled of them in
``kernels``. ``online_output`` makes an estimator of each; ``thinning`` gives one with a window, filter or smoother, no
more frames than the window may hold.
"""
