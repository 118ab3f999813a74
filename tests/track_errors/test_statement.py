"""A noise of tracks that is stated is held against the tracks: theirs passes, one that is far too small is named."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.divergence import gate_collapse
from toolkit.experiment.recording import Recording, prepare
from toolkit.sequence import Observations, Sequence
from toolkit.settings import Noise
from toolkit.track_errors import contradicted
from toolkit.track_errors.statement import MOST_SCATTER, scatter_over
from toolkit.track_noise import TrackNoise

PLANTED = TrackNoise(np.full(3, 0.01), np.full(3, 0.13), np.array([0.0, 0.7, 0.0]))


def test_tracks_scatter_as_much_as_their_own_noise_says_and_k_times_as_much_as_a_kth_of_it(walking: Sequence) -> None:
    own = scatter_over(PLANTED, walking)
    assert own == pytest.approx(1.0, abs=0.15)
    assert scatter_over(PLANTED.scaled(0.25), walking) == pytest.approx(4.0 * own, rel=0.02)
    assert contradicted(PLANTED, walking) is None
    assert contradicted(PLANTED.scaled(0.9 * own / MOST_SCATTER), walking) is not None


def test_white_tracks_contradict_the_settings_own_noise_and_the_facts_say_so(white: Sequence) -> None:
    short = white.truncated(30)
    facts = prepare(Recording(short, noise=Noise(tracks="correlated"))).sequence.provenance.facts
    (doubt,) = (fact for fact in facts if "scatter" in fact)
    assert "noise.tracks=fitted" in doubt
    right = Noise(tracks="correlated", track_white_px=0.7, track_walk_px=0.0, track_offset_px=0.0)
    facts = prepare(Recording(short, noise=right)).sequence.provenance.facts
    assert not any("scatter" in fact for fact in facts)


def test_without_sightings_nothing_is_reported(white: Sequence) -> None:
    none = np.empty(0, dtype=np.int64)
    assert contradicted(PLANTED, replace(white, observations=Observations(none, none, np.empty((0, 3))))) is None


def test_a_gate_that_collapsed_under_a_stated_noise_names_it() -> None:
    info = {"gate_tested": np.full(100, 20.0), "gate_accepted": np.zeros(100)}
    assert "noise.tracks" in str(gate_collapse(info, PLANTED))
    assert "noise.tracks" not in str(gate_collapse(info))
