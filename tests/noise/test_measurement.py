"""The noise of a recording: white as stated it is left alone, planted errors are found, nothing else is looked at."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.experiment.recording import Recording, prepare
from toolkit.geometry import IntArray
from toolkit.measurements import TwistChangeNoise
from toolkit.motion_samples import NoSamples
from toolkit.noise import measured_noise
from toolkit.noise.measurement import MotionScale, motion_scale
from toolkit.noise.stretches import MotionFit, Stretch
from toolkit.sequence import Sequence, is_held_out
from toolkit.settings import Noise
from toolkit.simulation import SCENARIOS, noise_free, simulate
from toolkit.simulation.faults import track_walk

AS_STATED = Noise(track_weight=1.0, motion_scale=1.0)


def recorded(name: str, duration_s: float, seed: int = 0) -> Sequence:
    return simulate(replace(SCENARIOS[name], duration_s=duration_s), seed)


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return recorded("drive", 6.0)


@pytest.mark.parametrize(
    ("name", "duration_s"),
    [("drive", 1.0), ("drive", 8.0), ("drive-imu", 1.0), ("drive-imu", 6.0), ("flight", 0.6), ("flight", 4.0)],
)
def test_white_errors_as_stated_leave_the_recording_as_it_is(name: str, duration_s: float) -> None:
    """To the bit: an estimator reads what it would read if both were set to one."""
    for seed in range(2):
        sequence = recorded(name, duration_s, seed)
        measured = measured_noise(sequence)
        assert (measured.why_not, measured.tracks.value, measured.motion.value) == ("", 1.0, 1.0)
    found, stated = (prepare(Recording(sequence, noise=noise)).sequence for noise in (Noise(), AS_STATED))
    assert found.content_hash() == stated.content_hash()


def test_the_more_tracks_walk_the_less_they_count(drive: Sequence) -> None:
    weights = [measured_noise(track_walk(drive, walk_px, 1)).tracks for walk_px in (0.3, 0.6, 1.2)]
    assert [weight.value for weight in weights] == sorted((weight.value for weight in weights), reverse=True)
    for weight in weights:
        assert weight.value + 5.0 * weight.error < 1.0
        assert weight.error < 0.2 * weight.value


def along_tracks(sequence: Sequence, cause: IntArray, sigma_px: float = 1.0, correlation: float = 0.6) -> Sequence:
    """Return a recording without noise whose sightings (N,) err by a first-order autoregression of their cause (N,)."""
    rng, seen = np.random.default_rng(0), sequence.observations
    steps = rng.standard_normal((sequence.frame_count, cause.max() + 1, 3))
    errors_px = steps.copy()
    for k in range(1, sequence.frame_count):
        errors_px[k] = correlation * errors_px[k - 1] + np.sqrt(1.0 - correlation**2) * steps[k]
    root = np.linalg.cholesky(sequence.rig.cov_uv_px2)
    uv_px = seen.uv_px + sigma_px * errors_px[seen.frame, cause] @ root.T
    return replace(sequence, observations=replace(seen, uv_px=uv_px))


def test_an_autoregression_along_tracks_has_its_design_effect_but_for_what_landmarks_take_of_it() -> None:
    exact = simulate(noise_free(replace(SCENARIOS["flight"], duration_s=5.0)), 0)
    own = np.unique(exact.observations.track_id, return_inverse=True)[1]
    weights = []
    for correlation in (0.4, 0.7, 0.9):
        weight = measured_noise(along_tracks(exact, own, correlation=correlation)).tracks
        effect = (1.0 - correlation) / (1.0 + correlation)
        # A landmark that is fitted to a dozen correlated sightings takes some of what they have in common.
        assert effect < weight.value < 4.0 * effect
        assert weight.neighbours == 1.0
        weights.append(weight.value)
    assert weights == sorted(weights, reverse=True)


def test_errors_that_neighbours_have_in_common_lower_the_weight() -> None:
    """Tracks of one patch of 80 px, from where they were first seen, err alike."""
    exact = simulate(noise_free(replace(SCENARIOS["drive"], duration_s=8.0)), 0)
    seen = exact.observations
    _, first, own = np.unique(seen.track_id, return_index=True, return_inverse=True)
    patch = np.unique(seen.uv_px[first][:, [0, 2]] // 80.0, axis=0, return_inverse=True)[1].ravel()
    alone, together = (measured_noise(along_tracks(exact, cause)).tracks for cause in (own, patch[own]))
    assert together.neighbours > 1.5
    assert together.value < 0.75 * alone.value


@pytest.mark.parametrize(("name", "noisier"), [("drive", 1.0), ("drive-imu", 1.0), ("flight", 20.0)])
def test_a_motion_that_errs_five_times_as_much_as_stated_is_found_within_its_error(name: str, noisier: float) -> None:
    """Beside half a pixel the noise of the flight's own IMU does not show."""
    motion = SCENARIOS[name].motion
    scenario = replace(SCENARIOS[name], duration_s=5.0, motion=replace(motion, noise=motion.noise.scaled(noisier)))
    sequence = simulate(scenario, 0)
    measured = measured_noise(replace(sequence, noise=sequence.noise.scaled(0.2)))
    assert measured.tracks.value == 1.0
    assert abs(measured.motion.value - 5.0) < 4.0 * measured.motion.error
    assert measured.motion.error < 1.0


@pytest.mark.parametrize("name", ["drive", "flight"])
def test_a_motion_that_errs_less_than_stated_is_taken_as_stated(name: str) -> None:
    sequence = recorded(name, 3.0)
    assert measured_noise(replace(sequence, noise=sequence.noise.scaled(5.0))).motion.value == 1.0


def test_a_step_after_which_nothing_could_be_adjusted_keeps_the_stated_noise() -> None:
    found = motion_scale(lambda scale: MotionFit(900.0, 100.0, 100.0) if scale == 1.0 else MotionFit(0.0, 0.0, 0.0))
    assert found == MotionScale(1.0, 0.0, ratio=9.0)


def test_neither_truth_nor_withheld_tracks_are_looked_at(drive: Sequence) -> None:
    walking = track_walk(drive, 0.6, 1)
    seen = walking.observations
    withheld = is_held_out(seen.track_id)
    assert withheld.any()
    moved = replace(seen, uv_px=seen.uv_px + np.where(withheld[:, None], [30.0, 20.0, -10.0], 0.0))
    found = measured_noise(walking)
    assert found.tracks.value < 1.0
    assert measured_noise(replace(walking, truth=None, prior=None)) == found
    assert measured_noise(replace(walking, observations=moved)) == found


def test_what_was_measured_is_kept_and_made_again_where_it_is_damaged(
    drive: Sequence, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = drive.truncated(20)
    found = measured_noise(short)
    (kept,) = (own_cache / "noise").iterdir()
    kept.write_bytes(kept.read_bytes()[:20])
    assert measured_noise(short) == found

    def unexpected(*_: object) -> None:
        raise AssertionError("it is adjusted again")

    monkeypatch.setattr(Stretch, "adjusted", unexpected)
    assert measured_noise(short) == found
    with pytest.raises(AssertionError, match="again"):
        measured_noise(short.truncated(19))


def only(sequence: Sequence, tracks: int) -> Sequence:
    """Return a recording with so many of its tracks that are not withheld."""
    seen = sequence.visible
    return replace(sequence, observations=seen.select(np.isin(seen.track_id, np.unique(seen.track_id)[:tracks])))


def left_alone(sequence: Sequence) -> Sequence:
    seen = sequence.observations
    return replace(sequence, observations=replace(seen, uv_px=seen.uv_px * [1.0, np.nan, 1.0]))


def seen_once(sequence: Sequence) -> Sequence:
    """Return a recording of which every sighting is a track of its own."""
    seen = sequence.observations
    return replace(sequence, observations=replace(seen, track_id=np.arange(len(seen))))


def unmeasured(sequence: Sequence) -> Sequence:
    return replace(sequence, motion=NoSamples(sequence.frames_t_ns), noise=TwistChangeNoise(np.ones(3), np.ones(3)))


@pytest.mark.parametrize("name", ["drive", "flight"])
@pytest.mark.parametrize(
    "change",
    [
        lambda sequence: only(sequence, 0),
        lambda sequence: only(sequence, 1),
        lambda sequence: sequence.truncated(7),
        left_alone,
        seen_once,
        lambda sequence: only(unmeasured(sequence), 3),
    ],
    ids=["no track", "one track", "seven frames", "left alone", "seen once", "no motion"],
)
def test_where_little_is_seen_the_noise_is_as_stated_and_all_figures_are_finite(
    name: str, change: Callable[[Sequence], Sequence]
) -> None:
    measured = measured_noise(change(recorded(name, 1.5)))
    assert (measured.tracks.value, measured.motion.value) == (1.0, 1.0)
    assert np.isfinite([measured.tracks.variance, measured.motion.ratio]).all()
    assert bool(measured.why_not) == (measured.tracks.pairs == 0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("wild_px", [1e5, 1e300])
def test_wild_values_end_nothing_and_change_little_or_are_told(drive: Sequence, wild_px: float) -> None:
    walking = track_walk(drive, 0.6, 1)
    uv_px = walking.observations.uv_px.copy()
    uv_px[200::1000] = wild_px * np.array([1.0, 0.5, 1.0])
    uv_px[500::1000, 0] = wild_px
    found = measured_noise(replace(walking, observations=replace(walking.observations, uv_px=uv_px)))
    if wild_px == 1e5:
        assert found.tracks.value == pytest.approx(measured_noise(walking).tracks.value, rel=0.3)
    else:  # one in every stretch, and none has a solution: the audit drops such values
        assert "do not determine the motion" in found.why_not


def test_without_measured_motion_tracks_are_weighed_alone(drive: Sequence) -> None:
    measured = measured_noise(unmeasured(track_walk(drive, 0.6, 1)))
    assert measured.tracks.value < 1.0
    assert measured.motion.value == 1.0


def test_on_request_the_beginning_alone_is_measured(drive: Sequence) -> None:
    seen = drive.observations
    later = track_walk(drive, 1.2, 1).observations.uv_px
    changed = replace(drive, observations=replace(seen, uv_px=np.where(seen.frame[:, None] < 25, seen.uv_px, later)))
    beginning, whole = (
        prepare(Recording(changed, noise=Noise(measured_s=measured_s))).sequence for measured_s in (2.4, None)
    )
    assert beginning.rig.track_weight == 1.0
    assert whole.rig.track_weight < 0.9
    with pytest.raises(DataError, match=r"noise.measured_s"):
        prepare(Recording(changed, noise=Noise(measured_s=0.01)))


def test_what_is_set_is_not_measured(drive: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    walking = track_walk(drive, 0.6, 1)
    one = prepare(Recording(walking, noise=Noise(track_weight=0.3))).sequence
    assert one.rig.track_weight == 0.3
    other = prepare(Recording(walking, noise=Noise(motion_scale=2.0))).sequence
    assert other.rig.track_weight < 1.0
    np.testing.assert_allclose(other.noise.gyro_noise_density, 2.0 * walking.noise.gyro_noise_density)
    monkeypatch.setattr("toolkit.experiment.recording.measured_noise", None)
    both = prepare(Recording(walking, noise=Noise(track_weight=0.3, motion_scale=2.0)))
    assert both.measured is None
