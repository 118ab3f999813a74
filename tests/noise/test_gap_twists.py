"""Where no track leads on, the measured twist is improved by vision around it, and everything else stays."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.experiment.recording import Recording, prepare
from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.measurements import TwistChangeNoise, TwistMotion
from toolkit.motion_samples import GapTwists, NoSamples, motions_between
from toolkit.noise import with_gap_twists
from toolkit.sequence import Sequence
from toolkit.settings import Noise
from toolkit.simulation import DRIVE, DRIVE_IMU, simulate
from toolkit.simulation.faults import cut_tracks


def gappy(seed: int, noisier: float = 1.0) -> Sequence:
    """Return a drive with gaps between tracks and an odometer that is so many times as noisy as usual, as stated."""
    odometer = replace(DRIVE.motion, noise=DRIVE.motion.noise.scaled(noisier))
    return cut_tracks(simulate(replace(DRIVE, duration_s=20.0, motion=odometer), seed), 0.15, seed)


def twists(sequence: Sequence, gaps: GapTwists | None, only: Array) -> Array:
    """Return the mean twists [turn rate, velocity] (G, 6) over intervals between frames, as estimators read them."""
    motions = list(motions_between(sequence.motion, sequence.frames_t_ns, sequence.bridges, gaps))
    means = [np.average(np.hstack([m.w_radps, m.v_mps]), axis=0, weights=m.dt_s) for m in motions]
    return np.array(means)[only]


def true_twists(sequence: Sequence, only: Array) -> Array:
    truth = sequence.truth
    assert truth is not None
    poses = truth.T_world_imu[np.searchsorted(truth.t_ns, sequence.frames_t_ns)]
    moved = se3_log(se3_inverse(poses[:-1]) @ poses[1:])
    return (moved / (np.diff(sequence.frames_t_ns) * 1e-9)[:, None])[only]


def errors_of(sequence: Sequence) -> tuple[GapTwists, Array, Array]:
    """Return the improved twists, and the root mean squares (6,) of the errors of measured and of improved ones."""
    gaps = with_gap_twists(sequence).gap_twists
    assert gaps is not None
    only = np.searchsorted(sequence.frames_t_ns, gaps.begin_t_ns)
    true = true_twists(sequence, only)
    rms = [np.sqrt(np.square(twists(sequence, given, only) - true).mean(axis=0)) for given in (None, gaps)]
    return gaps, rms[0], rms[1]


@pytest.mark.parametrize("seed", [0])
def test_over_a_gap_a_noisy_twist_comes_closer_to_the_true_one_and_states_its_error(seed: int) -> None:
    sequence = gappy(seed, 6.0)
    gaps, measured, improved = errors_of(sequence)
    assert len(gaps.begin_t_ns) > 15
    assert (improved[[2, 3]] < 0.7 * measured[[2, 3]]).all()  # the heading, and the velocity ahead
    stated = np.concatenate([sequence.noise.gyro_noise_density, sequence.noise.velocity_noise_density]) / np.sqrt(0.1)
    scale = np.repeat(np.sqrt(np.square(gaps.noise_scale).mean(axis=0))[::-1], 3)
    assert (scale < 1.0).all()
    # The variance of the change has vision's noise in it, so that the stated error is too large rather than too small.
    assert (improved < 1.5 * scale * stated).all()


def test_estimators_read_improved_twists_in_the_gaps_alone() -> None:
    sequence = gappy(2)
    repaired = with_gap_twists(sequence)
    assert repaired.gap_twists is not None
    gaps = np.searchsorted(sequence.frames_t_ns, repaired.gap_twists.begin_t_ns)
    for packet, before in zip(list(repaired.packets())[1:], list(sequence.packets())[1:], strict=True):
        assert isinstance(packet.motion, TwistMotion)
        assert isinstance(before.motion, TwistMotion)
        same = packet.motion.v_mps.shape == before.motion.v_mps.shape and (packet.motion.v_mps == before.motion.v_mps)
        assert np.all(same) == (packet.index - 1 not in gaps)
    assert any("noise.bridge_gaps" in fact for fact in repaired.provenance.facts)
    assert repaired.content_hash() != sequence.content_hash()


def test_a_twist_that_never_changes_leaves_an_improved_one_some_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toolkit.noise.gap_twists._change_variance", lambda *_: np.zeros(6))
    gaps = with_gap_twists(gappy(0)).gap_twists
    assert gaps is not None
    assert 0.0 < gaps.noise_scale.min() < 0.02


def test_it_can_be_switched_off() -> None:
    on, off = (prepare(Recording(gappy(0), noise=Noise(bridge_gaps=given))).sequence for given in (True, False))
    assert on.gap_twists is not None
    assert off.gap_twists is None


def without_motion(sequence: Sequence) -> Sequence:
    unmeasured = NoSamples(sequence.frames_t_ns)
    return replace(sequence, motion=unmeasured, noise=TwistChangeNoise(np.ones(3), np.ones(3)))


@pytest.mark.parametrize(
    "sequence",
    [
        simulate(replace(DRIVE, duration_s=4.0), 0),
        cut_tracks(simulate(replace(DRIVE_IMU, duration_s=4.0), 0), 0.2, 0),
        without_motion(gappy(0)),
        gappy(0).truncated(2),
        replace(gappy(0), observations=gappy(0).observations.select(np.zeros(0, dtype=np.int64))),
        cut_tracks(simulate(replace(DRIVE, duration_s=4.0), 0), 0.9, 0),
    ],
    ids=["no gap", "an IMU", "no measured motion", "two frames", "no track", "too few changes seen"],
)
def test_elsewhere_a_recording_is_left_as_it_is(sequence: Sequence) -> None:
    assert with_gap_twists(sequence) is sequence
