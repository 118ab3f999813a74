"""The state every estimator starts from, found without truth: from the first stereo frames and the motion samples.

Read ``start`` first: it says what each kind of motion needs. ``first_guess`` solves for it linearly, ``adjustment``
makes it exact and gives its covariance.
"""

from toolkit.initialization.adjustment import GYRO_BIAS_SIGMA
from toolkit.initialization.start import start_from_measurements, start_from_truth

__all__ = ["GYRO_BIAS_SIGMA", "start_from_measurements", "start_from_truth"]
