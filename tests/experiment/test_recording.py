"""What the estimators read: the noise, the start, the seeds and the cut that the settings ask for."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import Audit, Finding
from toolkit.datasets import load_sequence
from toolkit.errors import DataError
from toolkit.experiment import recording
from toolkit.experiment.pipeline import Plan, run
from toolkit.experiment.recording import Part, Recording, prepare
from toolkit.measurements import MotionNoise
from toolkit.sequence import Observations, Sequence
from toolkit.settings import Noise, Settings, SettingsError, TrackUse
from toolkit.simulation import SCENARIOS, faults, simulate

FOUND = Finding("time-gap", 1, repaired=False, detail="a gap", blocking=False)


def messages(source: str, **noise: float) -> tuple[np.ndarray, MotionNoise]:
    """Return the pixel covariance (3, 3) px^2 and the motion noise that estimators are told."""
    short = load_sequence(source).truncated(20)  # soon audited
    sequence = prepare(Recording(short, noise=Noise(**noise))).sequence
    return sequence.rig.cov_uv_px2, sequence.noise


def test_a_warning_of_times_that_are_not_run_is_none_of_the_runs_results():
    slipping = faults.disturbed_motion(simulate(replace(SCENARIOS["drive"], duration_s=12.0), 0), 2.0)  # at 5 to 10 s
    for part, concerned in ((Part(), True), (Part(to_s=4.0), False), (Part(from_s=9.0), True)):
        (conflict,) = (f for f in prepare(Recording(slipping, part=part)).findings if f.fault == "conflict")
        assert conflict.warning is concerned
        assert ("none of it is in the part that is run" in conflict.detail) is not concerned


def test_without_settings_the_noise_is_the_recordings_and_a_factor_scales_white_noise_and_no_random_walk():
    for source, densities in (
        ("drive", ("velocity_noise_density", "gyro_noise_density")),
        ("drive-imu", ("gyro_noise_density", "accel_noise_density")),
    ):
        recorded, (_, after) = load_sequence(source), messages(source, motion_scale=3.0)
        cov_uv_px2, before = messages(source)
        np.testing.assert_array_equal(cov_uv_px2, recorded.rig.cov_uv_px2)
        assert before == recorded.noise
        for name, value in vars(before).items():
            np.testing.assert_array_equal(getattr(after, name), (3.0 if name in densities else 1.0) * value)


def test_a_pixel_sigma_is_that_of_the_columns_and_the_row_keeps_its_proportion():
    recorded = load_sequence("drive").rig.cov_uv_px2
    cov_uv_px2, _ = messages("drive", pixel_sigma_px=0.7)
    np.testing.assert_allclose(np.diag(cov_uv_px2)[:2], 0.49, rtol=1e-12)
    np.testing.assert_allclose(cov_uv_px2 / cov_uv_px2[0, 0], recorded / recorded[0, 0], rtol=1e-12)


def test_a_pixel_sigma_that_the_tracks_refute_is_reported():
    """The audit reads the recording's own noise; estimators are told the one of the settings."""
    for sigma_px, expected in ((1.0, None), (30.0, "30 times too large"), (0.1, "9.99 times too small")):
        requested = Recording("drive", duration_s=5.0, noise=Noise(pixel_sigma_px=sigma_px))
        reported = {finding.fault: finding.detail for finding in prepare(requested).findings if finding.warning}
        assert set(reported) == ({"track-scatter"} if expected else set())
        assert expected is None or expected in reported["track-scatter"]


def test_frames_and_seconds_cut_a_recording_and_the_whole_is_kept():
    whole = load_sequence("drive").truncated(40)  # soon audited
    frames = prepare(Recording(whole, max_frames=7))
    assert (frames.sequence.frame_count, frames.whole.frame_count) == (7, whole.frame_count)
    seconds = prepare(Recording(whole, duration_s=1.0))
    t_ns = seconds.sequence.frames_t_ns
    assert t_ns[-1] - t_ns[0] <= 10**9 < whole.frames_t_ns[t_ns.size] - t_ns[0]


@pytest.mark.parametrize(
    ("requested", "findings", "audited_s"),
    [
        (Recording("drive", max_frames=7), (), [40]),
        (Recording("drive", part=Part(30.0, 50.0)), (), [50]),
        (Recording("drive", max_frames=7), (FOUND,), [40, 60]),
        (Recording("drive"), (FOUND,), [60]),
        (Recording("drive-realistic", max_frames=7), (), [60]),  # its tracks err otherwise than it states
    ],
)
def test_a_simulation_is_audited_as_far_as_it_is_run_and_whole_where_something_is_found(
    requested, findings, audited_s, monkeypatch
):
    lengths_s: list[float] = []
    undecided = {"lever-arm": "too little rotation"}

    def messages(sequence: Sequence, _keep: frozenset[str]) -> Audit:
        lengths_s.append(sequence.duration_s)
        return Audit(sequence, findings, undecided)

    monkeypatch.setattr(recording, "audit", messages)
    prepared = prepare(requested)
    assert lengths_s == audited_s
    assert (prepared.whole.duration_s, prepared.findings, prepared.undecided) == (60.0, findings, undecided)
    prepare(replace(requested, source=prepared.whole))  # as a recording of somebody's own
    assert lengths_s[-1] == 60.0


@pytest.mark.parametrize("name", [name for name, scenario in SCENARIOS.items() if scenario.audited_s is not None])
def test_the_beginning_of_a_simulation_leaves_no_more_undecided_than_the_whole(name):
    beginning, whole = (prepare(Recording(name, max_frames=frames)) for frames in (7, None))
    assert beginning.findings == whole.findings == ()
    assert beginning.undecided.keys() <= whole.undecided.keys()


def test_a_part_is_what_lies_between_its_times_thinned_and_is_reported():
    whole = load_sequence("drive").truncated(40)  # 10 Hz
    prepared = prepare(Recording(whole, part=Part(1.0, 3.0, 3), max_frames=5))
    np.testing.assert_array_equal(prepared.sequence.frames_t_ns, whole.frames_t_ns[10:31:3][:5])
    assert prepared.sequence.provenance.facts[-1] == "a part of the recording: from 1 s to 3 s, one frame in 3"
    assert prepared.whole.frame_count == 40
    seen, all_seen = prepared.sequence.observations, whole.observations
    np.testing.assert_array_equal(seen.uv_px[seen.frame == 1], all_seen.uv_px[all_seen.frame == 13])
    # The prior was that of the first frame of the whole.
    assert prepared.prior.source != prepare(Recording(whole)).prior.source


def test_the_motion_between_thinned_frames_is_whole():
    whole = load_sequence("drive").truncated(9)
    packets = list(whole.packets())
    thinned = list(prepare(Recording(whole, part=Part(every=2))).sequence.packets())
    for k in range(1, 5):
        one, two = packets[2 * k - 1].motion, packets[2 * k].motion
        both = thinned[k].motion
        np.testing.assert_array_equal(both.v_mps, np.concatenate([one.v_mps, two.v_mps]))


def test_the_truth_of_thinned_frames_is_at_those_that_stay_and_its_own_where_it_has_other_stamps():
    whole = load_sequence("flight").truncated(21)
    every = Recording(whole, part=Part(every=5))
    thinned, truth = prepare(every).sequence, whole.truth
    np.testing.assert_array_equal(thinned.truth.t_ns, thinned.frames_t_ns)
    np.testing.assert_array_equal(thinned.truth.T_world_imu, truth.T_world_imu[:21:5])
    np.testing.assert_array_equal(thinned.truth.v_world, truth.v_world[:21:5])
    elsewhere = replace(whole, truth=replace(truth, t_ns=truth.t_ns + 2_000_000))
    for requested in (replace(every, source=elsewhere), Recording(whole)):
        kept = prepare(requested).sequence.truth
        assert kept.t_ns.size == truth.t_ns.size


def test_a_part_without_two_frames_is_refused_with_what_there_is():
    whole = load_sequence("drive").truncated(20)
    with pytest.raises(DataError, match=r"drive: from 5 s to the end it has 0 frame\(s\).* it has 20 in 1.9 s"):
        prepare(Recording(whole, part=Part(5.0)))


def test_a_budget_of_tracks_is_kept_and_reported():
    prepared = prepare(Recording(load_sequence("drive").truncated(20), tracks=TrackUse(budget=25)))
    assert np.bincount(prepared.sequence.visible.frame).max() == 25
    assert prepared.sequence.provenance.facts[-1].startswith(
        "estimators are given at most 25 tracks a frame (tracks.budget): "
    )
    assert prepared.whole.track_budget is None


def test_a_world_is_drawn_of_simulations_alone():
    fixed, drawn = (prepare(Recording("drive", duration_s=1.0, vary=vary)).sequence for vary in ("noise", "world"))
    assert np.abs(fixed.truth.T_world_imu - drawn.truth.T_world_imu).max() > 0.01
    with pytest.raises(SettingsError, match="vary=world draws a simulated world"):
        prepare(Recording(fixed, vary="world"))


@pytest.mark.parametrize("ids", [lambda track: -track - 1, lambda track: track + 2**56, lambda track: track * 2**50])
def test_tracks_whose_ids_no_graph_can_have_are_numbered_anew_and_estimators_run(ids):
    short = load_sequence("drive").truncated(12)
    seen = short.observations
    named = replace(short, observations=Observations.sorted(seen.frame, ids(seen.track_id), seen.uv_px))
    prepared = prepare(Recording(named)).sequence
    assert {*np.unique(prepared.observations.track_id)} == {*range(np.unique(seen.track_id).size)}
    assert "tracks are numbered anew" in prepared.provenance.facts[-1]
    compared = run(Plan((named,), ("batch", "fixed-lag", "isam2"), workers=1))[0]
    assert [one.status for one in compared.runs] == ["ok"] * 3


def test_what_estimators_do_about_biases_needs_no_recording_of_its_own() -> None:
    fixed = Settings(noise=Noise(biases="fixed"))
    assert Recording.under(fixed, "flight", 3) == Recording.under(Settings(), "flight", 3)
