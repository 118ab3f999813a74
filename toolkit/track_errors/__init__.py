"""What the errors of real tracks are like, found from a recording's own visible tracks, without truth.

Read ``tracklets`` (the tracks, by length), ``linearised`` (their residuals and derivatives), ``adjustment`` (poses that
suit all tracks), ``likelihood`` (how probable a noise makes the residuals) and ``fit`` (which noise it is).
"""

from toolkit.track_errors.fit import Fit, fit_track_noise, in_words

__all__ = ["Fit", "fit_track_noise", "in_words"]
