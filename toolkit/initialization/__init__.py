"""The state every estimator starts from, found without truth: from the first stereo frames and the motion samples.

Read ``start``: what each kind of motion needs, and the adjustment of the first frames from a linear ``first_guess``.
"""

from toolkit.initialization.start import GYRO_BIAS_SIGMA, start_from_measurements, start_from_truth

__all__ = ["GYRO_BIAS_SIGMA", "start_from_measurements", "start_from_truth"]
