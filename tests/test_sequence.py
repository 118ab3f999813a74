"""The stream every estimator reads: packets cut once, tracks withheld from all, values nobody can change."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry import se3, se3_exp
from toolkit.measurements import NS_PER_S, ImuNoise, StereoRig, TwistNoise
from toolkit.motion_samples import ImuSamples, Pairing, TwistSamples
from toolkit.sequence import Observations, Provenance, Sequence, is_held_out
from toolkit.simulation import DRIVE, FLIGHT, simulate

RIG = StereoRig(500.0, 500.0, 320.0, 240.0, 0.2, np.eye(4), np.eye(3))
THREE = np.full(3, 0.1)
START_NS = 1_600_000_000 * NS_PER_S


def at_ms(*stamps_ms: float) -> np.ndarray:
    return START_NS + np.round(1e6 * np.array(stamps_ms)).astype(np.int64)


def sequence_of(frames_t_ns: np.ndarray, motion: TwistSamples | ImuSamples) -> Sequence:
    return Sequence(
        name="made",
        rig=RIG,
        noise=TwistNoise(THREE, THREE, THREE) if isinstance(motion, TwistSamples) else ImuNoise(1.0, 1.0, 1.0, 1.0),
        frames_t_ns=frames_t_ns,
        observations=Observations(np.empty(0), np.empty(0), np.empty((0, 3))),
        motion=motion,
        provenance=Provenance("test", "tests/test_sequence.py"),
    )


def ramp(stamps_ns: np.ndarray) -> np.ndarray:
    """Values that grow linearly with time: (S, 3), 1 a second on the first axis, 10 and 100 on the others."""
    return ((stamps_ns - START_NS) / NS_PER_S)[:, None] * np.array([1.0, 10.0, 100.0])


def twists(stamps_ns: np.ndarray, pairing: Pairing) -> TwistSamples:
    return TwistSamples(stamps_ns, ramp(stamps_ns), -ramp(stamps_ns), pairing)


@pytest.mark.parametrize(("pairing", "expected"), [("start", [0.0, 0.1]), ("end", [0.1, 0.2]), ("mean", [0.05, 0.15])])
def test_pairing_says_which_sample_moves_from_frame_to_frame(pairing, expected):
    frames = at_ms(0, 100, 200)
    first, *moved = sequence_of(frames, twists(frames, pairing)).packets()
    assert first.motion is None
    for packet, value in zip(moved, expected, strict=True):
        np.testing.assert_allclose(packet.motion.dt_s, [0.1], rtol=1e-12)
        np.testing.assert_allclose(packet.motion.v_mps, value * np.array([[1.0, 10.0, 100.0]]), atol=1e-9)
        np.testing.assert_allclose(packet.motion.w_radps, -packet.motion.v_mps)


def test_a_sample_in_the_middle_stands_for_the_time_around_it_and_is_shared_out_by_the_frames():
    stamps = at_ms(-5, 5, 15, 25, 35)
    motion = ImuSamples(stamps, ramp(stamps), -ramp(stamps), "middle")
    _, first, second = sequence_of(at_ms(0, 20, 27), motion).packets()
    np.testing.assert_allclose(first.motion.dt_s, [0.01, 0.01], rtol=1e-9)
    np.testing.assert_allclose(first.motion.accel_mps2[:, 0], [0.005, 0.015], atol=1e-12)
    np.testing.assert_allclose(second.motion.dt_s, [0.007], rtol=1e-9)
    np.testing.assert_allclose(second.motion.accel_mps2[:, 0], [0.025], atol=1e-12)


def test_imu_samples_are_cut_and_interpolated_at_the_frames():
    """Frames between the samples: the pieces are the trapezoids of the linear interpolation, none lost or doubled."""
    stamps = at_ms(*np.arange(0.0, 101.0, 5.0))
    frames = at_ms(7, 33.5, 50, 91)
    packets = list(sequence_of(frames, ImuSamples(stamps, ramp(stamps), -ramp(stamps))).packets())
    for before, packet in pairwise(packets):
        start_s, end_s = ((p.frame.t_ns - START_NS) / NS_PER_S for p in (before, packet))
        # Stamps are whole nanoseconds.
        assert packet.motion.dt_s.sum() == pytest.approx(end_s - start_s, abs=1e-12)
        integral = packet.motion.dt_s @ packet.motion.accel_mps2
        expected = 0.5 * (end_s**2 - start_s**2) * np.array([1.0, 10.0, 100.0])
        # Linear interpolation on stamps of 1 ns over 100 ms.
        np.testing.assert_allclose(integral, expected, rtol=1e-7)
        assert (packet.motion.dt_s > 0.0).all()


def test_a_longer_recording_begins_with_the_same_packets():
    sequence = simulate(replace(FLIGHT, duration_s=2.0), 0)
    for short, long in zip(sequence.truncated(17).packets(), sequence.packets(), strict=False):
        np.testing.assert_array_equal(short.frame.uvs_px, long.frame.uvs_px)
        if long.motion is not None:
            np.testing.assert_array_equal(short.motion.accel_mps2, long.motion.accel_mps2)
            np.testing.assert_array_equal(short.motion.dt_s, long.motion.dt_s)
    assert sequence.truncated(17).frame_count == 17
    assert sequence.truncated(10**6) is sequence


def test_withheld_tracks_never_reach_an_estimator():
    sequence = simulate(replace(DRIVE, duration_s=5.0), 0)
    shown = np.concatenate([p.frame.track_ids for p in sequence.packets()])
    assert not is_held_out(shown).any()
    assert is_held_out(sequence.held_out.track_id).all()
    assert len(sequence.held_out) + shown.size == len(sequence.observations)


@pytest.mark.parametrize("ids", [np.arange(20_000), 7919 * np.arange(20_000), 10**12 + np.arange(20_000)])
def test_one_track_in_ten_is_withheld_whatever_the_numbering(ids):
    # A fair draw of 20,000 has a standard deviation of 0.2 %.
    assert is_held_out(ids).mean() == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("digits", [None, 6])
def test_the_hash_sees_what_an_estimator_sees_and_a_rounded_one_no_last_bits(digits):
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    same = simulate(replace(DRIVE, duration_s=1.0), 0)
    assert sequence.content_hash(digits) == same.content_hash(digits)
    nearly = replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, sequence.motion.values * (1.0 + 1e-15)))
    assert (nearly.content_hash(digits) == sequence.content_hash(digits)) is (digits is not None)
    uv_px = sequence.observations.uv_px.copy()
    uv_px[3, 1] += 0.01
    changes = {
        "observations": replace(sequence.observations, uv_px=uv_px),
        "frames_t_ns": sequence.frames_t_ns + 1,
        "gravity_world": np.array([0.0, 0.0, -9.8]),
        "truth": None,
        "prior": None,
        "rig": replace(sequence.rig, baseline_m=0.5401),
        "motion": replace(sequence.motion, pairing="end"),
        "noise": replace(sequence.noise, gyro_random_walk=THREE),
    }
    hashes = {replace(sequence, **{name: value}).content_hash(digits) for name, value in changes.items()}
    assert len(hashes | {sequence.content_hash(digits)}) == len(changes) + 1


FRAMES = at_ms(0, 100, 200)


@pytest.mark.parametrize(
    ("frames", "stamps", "complaint"),
    [
        (at_ms(0), at_ms(0, 100), "1 frame"),
        (at_ms(0, 200, 100), at_ms(0, 100, 200), "frame 2 is not after"),
        (at_ms(0, 100, 100), at_ms(0, 100, 200), "frame 2 is not after"),
        (FRAMES, at_ms(0, 100, 100, 200), "motion sample 2 is not after"),
        (FRAMES, at_ms(50, 100, 200), "do not span"),
        (FRAMES, at_ms(0, 100), "do not span"),
        (FRAMES, at_ms(), "no motion samples"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(frames, stamps, complaint):
    with pytest.raises(DataError, match=complaint) as refused:
        next(iter(sequence_of(frames, twists(stamps, "start")).packets()))
    assert str(refused.value).startswith("made: ")
    assert "\n" not in str(refused.value)
    with pytest.raises(DataError, match="not of the kind"):
        replace(sequence_of(FRAMES, twists(FRAMES, "start")), noise=ImuNoise(1.0, 1.0, 1.0, 1.0))


def test_an_extrinsic_written_with_few_decimals_is_made_a_rotation():
    """Calibrations have three to nine decimals; the models take the transpose for the inverse."""
    exact = se3_exp(np.array([0.7, -1.1, 0.4, 0.1, 0.2, 0.3]))
    rig = replace(RIG, T_imu_cam=np.round(exact, 4))
    rotation = rig.T_imu_cam[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    # Nearest to what was written, which is within 5e-5 an entry of the exact one.
    np.testing.assert_allclose(rig.T_imu_cam, exact, atol=1e-4)
    assert replace(RIG, T_imu_cam=exact).T_imu_cam.tolist() == exact.tolist()


@pytest.mark.parametrize(
    "rotation", [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.full((3, 3), np.nan)]
)
def test_an_extrinsic_that_is_no_rigid_motion_is_refused(rotation):
    with pytest.raises(DataError, match=r"T_imu_cam (is not a rotation and a translation|holds a reflection)"):
        replace(RIG, T_imu_cam=se3(rotation, np.zeros(3)))
    with pytest.raises(DataError, match=r"T_imu_cam: the last row is \[1.0, 2.0, 3.0, 1.0\].*transpose it"):
        replace(RIG, T_imu_cam=se3(np.eye(3), np.array([1.0, 2.0, 3.0])).T)


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("noise", "gyro_noise_density", np.zeros(3)),
        ("noise", "velocity_noise_density", np.array([0.1, np.nan, 0.1])),
        ("rig", "fx_px", 0.0),
        ("rig", "baseline_m", -0.5),
        ("rig", "cov_uv_px2", np.zeros((3, 3))),
        ("rig", "cx_px", np.inf),
    ],
)
def test_a_noise_or_calibration_that_can_be_none_is_named(part: str, key: str, value: object) -> None:
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    sequence = replace(sequence, **{part: replace(getattr(sequence, part), **{key: value})})
    with pytest.raises(DataError, match=f"{part}.{key}"):
        next(sequence.packets())
