"""Compare a handwritten stereo visual-inertial EKF with a GTSAM smoother on the same measurements.

Reading order: sequence -> models -> filters/ekf -> filters/batch -> metrics -> report.
"""
