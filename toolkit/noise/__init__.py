"""How noisy a recording really is: one weight of its tracks and one factor on its motion, the same for every estimator.

A filter and a smoother are compared fairly only with the same noise, and errors of real recordings are not white as
stated. Both figures are measured once, before any estimator runs, from the recording alone: no truth, no withheld
track. Read ``stretches`` (what is adjusted), ``correlation`` (the weight of tracks), ``motion`` (the factor on the
motion's noise), ``measurement`` (both, kept under the hash of the recording).
"""

from toolkit.noise.measurement import MeasuredNoise, measured_noise

__all__ = ["MeasuredNoise", "measured_noise"]
