"""How noisy a recording really is: one weight of its tracks and one factor on its motion, the same for every estimator.

A filter and a smoother are compared fairly only with the same noise, and errors of real recordings are not white as
stated. Both figures are measured once, before any estimator runs, from the recording alone: no truth, no withheld
track. Read ``stretches`` (what is adjusted), ``correlation`` (the weight of tracks), ``measurement`` (that and the
factor on the motion's noise, kept under the hash of the recording), ``card`` (what the tracks are like) and
``gap_twists`` (the motion where no track leads on).
"""

from toolkit.noise.card import Card, card_of
from toolkit.noise.correlation import TrackWeight
from toolkit.noise.gap_twists import with_gap_twists
from toolkit.noise.measurement import MeasuredNoise, MotionScale, measured_noise

__all__ = ["Card", "MeasuredNoise", "MotionScale", "TrackWeight", "card_of", "measured_noise", "with_gap_twists"]
