"""What the errors of real tracks are like, found from a recording's own visible tracks, without truth.

Read ``tracklets`` (the tracks, by length), ``likelihood`` (their residuals, and how probable a noise makes them),
``adjustment`` (poses that suit all tracks), ``fit`` (which noise it is), ``card`` (what is told of it), and
``statement`` (whether a noise that is stated can be theirs).
"""

from toolkit.track_errors.card import Card, card_of
from toolkit.track_errors.fit import Fit, fit_track_noise, summary_of
from toolkit.track_errors.statement import contradicted

__all__ = ["Card", "Fit", "card_of", "contradicted", "fit_track_noise", "summary_of"]
