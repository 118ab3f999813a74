"""Statistics of the errors of real tracks, from a recording's own visible tracks, without truth.

Read ``tracklets`` (the tracks by length, their residuals, the likelihood of a noise), ``adjustment`` (poses that fit
all tracks), ``fit`` (the noise of greatest likelihood), ``card`` (its summary), and ``statement`` (whether a stated
noise can be that of the tracks).
"""

from toolkit.track_errors.card import Card, card_of
from toolkit.track_errors.fit import Fit, fit_track_noise, summary_of
from toolkit.track_errors.statement import contradicted

__all__ = ["Card", "Fit", "card_of", "contradicted", "fit_track_noise", "summary_of"]
