"""What each repair leaves: the clean recording again, or exactly what the fault's page promises."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import clean_recording, planted, recording, with_pixels
from toolkit.audit import audit
from toolkit.audit.alignment import is_excluded, is_there
from toolkit.audit.robust import Scalar
from toolkit.geometry import Array, se3, so3_exp
from toolkit.measurements import TwistMotion, is_left_only
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import SCENARIOS, faults, simulate
from toolkit.verify import short


@pytest.mark.parametrize(
    "fault",
    [
        "time-order",
        "extrinsic-translation",
        faults.baseline_unit,
        faults.extrinsic_unit,
        faults.inverted_extrinsic,
        faults.linear_unit,
        faults.angular_unit,
    ],
)
def test_a_repair_gives_the_clean_recording_again(fault: str | Callable[[Sequence], Sequence]) -> None:
    clean = recording("drive", 0)
    repaired = audit(planted(fault, clean) if isinstance(fault, str) else fault(clean)).sequence
    assert repaired.content_hash(9) == clean.content_hash(9)  # but for the rounding of a conversion


def test_twists_that_were_late_are_paired_with_their_intervals() -> None:
    clean = recording("drive", 0, 30.0)
    packets = (audit(planted("twist-lag", clean)).sequence.packets(), clean.packets())
    for late, sound in zip(*packets, strict=True):
        if isinstance(late.motion, TwistMotion) and isinstance(sound.motion, TwistMotion):
            np.testing.assert_array_equal(late.motion.v_mps, sound.motion.v_mps)


def test_a_frame_with_the_stamp_of_another_goes_with_its_sightings() -> None:
    clean = clean_recording()
    stamps = clean.frames_t_ns.copy()
    stamps[50], stamps[70] = stamps[49], np.iinfo(np.int64).min  # what a stamp that is no number is read as
    repaired = audit(replace(clean, frames_t_ns=stamps)).sequence
    assert np.array_equal(repaired.frames_t_ns, np.delete(clean.frames_t_ns, [50, 70]))
    assert len(repaired.observations) == np.sum(~np.isin(clean.observations.frame, [50, 70]))


def test_the_longest_stretch_between_motion_gaps_is_kept() -> None:
    clean = clean_recording()
    faulty = planted("time-gap", clean)
    hole = int(np.argmax(np.diff(faulty.motion.t_ns)))
    repaired = audit(faulty).sequence
    assert np.array_equal(repaired.frames_t_ns, clean.frames_t_ns[clean.frames_t_ns >= faulty.motion.t_ns[hole + 1]])
    assert repaired.prior is None  # it was the state at another frame


def test_a_gap_in_the_frames_alone_is_information() -> None:
    clean = clean_recording()
    kept = np.delete(np.arange(clean.frame_count), range(70, 74))
    new_index = np.cumsum(np.isin(np.arange(clean.frame_count), kept)) - 1
    # Its tracks end at the gap, or they would be called back from an absence no frame shows.
    observations = clean.observations.select(clean.observations.frame < 70)
    sequence = replace(
        clean,
        frames_t_ns=clean.frames_t_ns[kept],
        observations=replace(observations, frame=new_index[observations.frame]),
    )
    outcome = audit(sequence)
    # Nothing is seen after the gap, which is told as well.
    found = [(f.fault, f.repaired, f.blocking) for f in outcome.findings]
    assert found == [("time-gap", False, False), ("thin-vision", False, False)]
    assert outcome.sequence is sequence


def test_repeated_tracks_end_at_a_stale_frame_and_start_anew_after_it() -> None:
    faulty = planted("stale-frames", clean_recording())
    repaired = audit(faulty).sequence.observations
    last_before = set(repaired.track_id[repaired.frame == 39].tolist())
    in_stale = set(repaired.track_id[repaired.frame == 40].tolist())
    first_after = set(repaired.track_id[repaired.frame == 41].tolist())
    assert not last_before & in_stale
    assert not last_before & first_after
    survivors = faulty.observations.track_id
    carried = np.intersect1d(survivors[faulty.observations.frame == 39], survivors[faulty.observations.frame == 40])
    dropped = len(faulty.observations) - len(repaired)
    assert dropped > carried.size > 4
    assert len(set(zip(repaired.frame.tolist(), repaired.track_id.tolist(), strict=True))) == len(repaired)


def test_doubled_disparities_are_what_they_were_and_no_other_sighting_is_touched() -> None:
    clean = clean_recording()
    faulty = planted("doubled-disparity", clean).observations
    repaired = audit(replace(clean, observations=faulty)).sequence.observations
    o = clean.observations
    pixel_of = dict(zip(zip(o.frame, o.track_id, strict=True), o.uv_px, strict=True))
    expected = [pixel_of[seen] for seen in zip(repaired.frame, repaired.track_id, strict=True)]
    np.testing.assert_allclose(repaired.uv_px, expected, rtol=0.0, atol=1e-9)
    assert len(repaired) == len(faulty)


def test_a_wall_that_comes_ever_nearer_is_not_taken_for_a_doubling() -> None:
    """Points at one depth that halves in every interval: the ratio is 2 for all of them, but does not stop."""
    clean, tracks, frames = clean_recording(), 12, 4
    frame, track_id = np.divmod(np.arange(tracks * frames), tracks)
    disparity, left = 10.0 * 2.0**frame, 300.0 + 20.0 * track_id
    uv_px = np.column_stack([left, left - disparity, np.full(left.size, 200.0)])
    nearing = replace(clean, observations=Observations(frame, track_id, uv_px))
    assert "doubled-disparity" not in {f.fault for f in audit(nearing).findings}


def test_a_drive_seen_once_a_second_is_not_taken_for_a_doubling() -> None:
    """From one frame to the next it comes half the way to what it sees, and few of the tracks live on."""
    drive = SCENARIOS["drive-imu"]
    camera = replace(drive.camera, rate_hz=1.0, max_tracks=15, loss_per_frame=0.3)
    sequence = simulate(replace(drive, camera=camera, duration_s=10.0, varied=True), 15)
    assert "doubled-disparity" not in {f.fault for f in audit(sequence).findings}


def test_a_parked_vehicle_that_repeats_its_pixels_is_not_stale() -> None:
    clean = clean_recording()
    o, m = clean.observations, clean.motion
    moving = o.frame >= 20
    parked = np.flatnonzero(o.frame == 20)
    frame = np.concatenate([np.repeat(np.arange(20), parked.size), o.frame[moving]])
    track_id = np.concatenate([np.tile(o.track_id[parked], 20), o.track_id[moving]])
    uv_px = np.concatenate([np.tile(o.uv_px[parked], (20, 1)), o.uv_px[moving]])
    at_rest = m.of(m.t_ns, np.where((m.t_ns <= clean.frames_t_ns[20])[:, None], 0.0, m.values))
    standing = replace(clean, observations=type(o).sorted(frame, track_id, uv_px), motion=at_rest)
    assert "stale-frames" not in {f.fault for f in audit(standing).findings}
    # Odometry that goes on tells of a camera that froze.
    assert "stale-frames" in {f.fault for f in audit(replace(standing, motion=m)).findings}


TURNS = [np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])]


@pytest.mark.parametrize(
    ("scenario", "of_the", "turn"),
    [
        *(("drive", "body", turn) for turn in (TURNS[0], np.eye(3)[[1, 2, 0]])),
        ("drive", "body, beside a place measured in the right axes", TURNS[1]),
        ("flight", "body", so3_exp(np.array([0, 0, np.pi / 2]))),
        ("flight", "camera", TURNS[2]),
    ],
)
def test_any_right_handed_turn_of_the_axes_is_undone(scenario: str, of_the: str, turn: Array) -> None:
    clean, T = clean_recording(scenario, 0, 15.0), se3(turn, np.zeros(3))
    rig = clean.rig
    T_imu_cam = rig.T_imu_cam @ T if of_the == "camera" else T @ rig.T_imu_cam
    if "place" in of_the:
        T_imu_cam[:3, 3] = rig.T_imu_cam[:3, 3]
    outcome = audit(replace(clean, rig=replace(rig, T_imu_cam=T_imu_cam)))
    assert [f.fault for f in outcome.findings] == ["mixed-axes"]
    # Turns are exact; what is left is rounding.
    np.testing.assert_allclose(outcome.sequence.rig.T_imu_cam, rig.T_imu_cam, atol=1e-12)


def test_nothing_is_concluded_from_tracks_whose_axes_are_left_to_choose() -> None:
    """Forty tracks of an inverted extrinsic: the camera was then put elsewhere and the prior's gyro bias widened."""
    drive = simulate(short(SCENARIOS["drive"], 10.0), 4)
    outcome = audit(faults.inverted_extrinsic(drive))
    assert [(found.fault, found.blocking) for found in outcome.findings] == [("mixed-axes", True)]
    assert "choose one" in outcome.findings[0].detail
    assert outcome.undecided["extrinsic-translation"].startswith("mixed-axes must be corrected")
    assert outcome.sequence.prior is drive.prior


def test_a_place_is_taken_excluded_or_left_open_by_its_odds() -> None:
    """Odds of a normal error about the way's end and its begin: a thousand to one for it, twenty to one against it."""
    assert is_there(Scalar(1.0, 0.26)) and not is_there(Scalar(1.0, 0.28))
    assert is_excluded(Scalar(0.0, 0.4)) and not is_excluded(Scalar(0.0, 0.42))
    assert is_excluded(Scalar(2.0, 0.2)) and not is_there(Scalar(2.0, 0.2))  # beyond it, where neither is


def test_noise_does_not_make_the_mean_of_two_samples_look_right() -> None:
    """A mean has half the noise, so a least-squares lag would answer one half; this one says nothing instead."""
    clean, rng = clean_recording("drive"), np.random.default_rng(0)
    w_radps = clean.motion.w_radps + 0.05 * rng.standard_normal(clean.motion.w_radps.shape)
    assert audit(replace(clean, motion=replace(clean.motion, w_radps=w_radps))).findings == ()


@pytest.mark.parametrize(
    ("bias_radps", "has_prior", "repaired"),
    [
        ((-0.01, -0.01, -0.01), False, False),
        ((0.0, 0.0, -0.02), True, True),
        ((0.0, 0.1, 0.0), False, True),
        ((0.0, -0.15, 0.0), False, True),
    ],
)
def test_a_gyro_bias_is_left_to_the_filters_unless_their_prior_or_start_without_one_denies_it(
    bias_radps: tuple[float, ...], has_prior: bool, repaired: bool
) -> None:
    clean = clean_recording("drive")
    motion = replace(clean.motion, w_radps=clean.motion.w_radps + np.array(bias_radps))
    outcome = audit(replace(clean, motion=motion, prior=clean.prior if has_prior else None))
    (finding,) = outcome.findings
    assert (finding.fault, finding.repaired, finding.blocking) == ("gyro-bias", repaired, False)
    assert finding.count == np.count_nonzero(bias_radps)
    if has_prior:  # it is widened
        assert clean.prior is not None and outcome.sequence.prior is not None
        added = np.diag(outcome.sequence.prior.cov - clean.prior.cov)
        np.testing.assert_allclose(np.sqrt(added), np.abs(np.r_[np.zeros(12), bias_radps]), atol=0.004)  # 3 sigma
    elif repaired:  # it is taken off
        np.testing.assert_allclose(outcome.sequence.motion.values, clean.motion.values, atol=0.0045)  # 3 sigma
    else:
        assert outcome.sequence.motion is motion


def test_a_standstill_shows_the_gyro_bias_without_a_camera() -> None:
    clean, rng = clean_recording("drive"), np.random.default_rng(0)
    v_mps = clean.motion.v_mps.copy()
    w_radps = clean.motion.w_radps.copy()
    v_mps[:80] = 0.001 * rng.standard_normal((80, 3))
    w_radps[:80] = -0.01 + 0.005 * rng.standard_normal((80, 3))
    blind = replace(clean, observations=clean.observations.select(np.zeros(len(clean.observations), dtype=bool)))
    no_sightings, finding = audit(replace(blind, motion=replace(clean.motion, v_mps=v_mps, w_radps=w_radps))).findings
    assert no_sightings.fault == "no-sightings"
    assert (finding.fault, finding.count) == ("gyro-bias", 3)
    assert "80 samples at standstill" in finding.detail


def test_faults_that_come_together_are_all_repaired() -> None:
    faulty = clean = clean_recording("drive", 2, 30.0)
    together = ("extrinsic-translation", "mixed-axes", "twist-lag", "stale-frames", "no-disparity")
    for fault in together:
        faulty = planted(fault, faulty)
    outcome = audit(faulty)
    assert {f.fault for f in outcome.findings if f.repaired} == {*together}
    np.testing.assert_allclose(outcome.sequence.rig.T_imu_cam, clean.rig.T_imu_cam, atol=1e-12)


@pytest.mark.parametrize("filler", [-999.0, 0.0])
def test_missing_sightings_written_as_one_value_are_dropped(filler: float) -> None:
    clean = clean_recording("drive")
    seen = clean.observations
    frame, track_id = (np.concatenate([part, part]) for part in (seen.frame, seen.track_id))
    both = Observations.sorted(frame, track_id, np.concatenate([seen.uv_px, np.full_like(seen.uv_px, filler)]))
    (finding,) = audit(replace(clean, observations=both)).findings
    assert finding.fault == "swapped-coordinates" and finding.repaired
    assert f"missing ones, written as {filler:g}" in finding.detail


@pytest.mark.parametrize("filler", [-1.0, 9999.0])
def test_missing_right_images_written_as_one_value_become_sightings_by_the_left_one(filler: float) -> None:
    clean = clean_recording("drive")
    right, both = (np.arange(len(clean.observations)) % 20 == place for place in (0, 1))
    uv_px = np.where(both[:, None], filler, clean.observations.uv_px)
    uv_px[right, 1] = filler
    outcome = audit(with_pixels(clean, uv_px))
    assert f"{right.sum()} of {right.size} sightings have a uR of {filler:g}" in outcome.findings[0].detail
    kept = outcome.sequence.observations.uv_px
    assert (len(kept), is_left_only(kept).sum()) == (len(uv_px) - both.sum(), right.sum())


@pytest.mark.parametrize("begin, end", [(0.0, 0.3), (0.2, 0.8), (0.6, 1.0)], ids=["beginning", "middle", "end"])
def test_a_camera_that_freezes_for_longer_than_tracks_last_is_named(begin: float, end: float) -> None:
    sequence = clean_recording("drive")
    first, last = (int(share * (sequence.frame_count - 1)) for share in (begin, end))
    seen = sequence.observations
    here, rest = np.flatnonzero(seen.frame == first), np.flatnonzero((seen.frame <= first) | (seen.frame > last))
    rows = np.concatenate([rest, np.tile(here, last - first)])
    frame = np.concatenate([seen.frame[rest], np.repeat(np.arange(first + 1, last + 1), here.size)])
    frozen = replace(sequence, observations=Observations.sorted(frame, seen.track_id[rows], seen.uv_px[rows]))
    finding = next(finding for finding in audit(frozen).findings if finding.fault == "stale-frames")
    assert finding.blocking and finding.count == last - first
