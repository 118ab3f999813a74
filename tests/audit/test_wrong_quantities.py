"""What stands in a file for something else is named for what it is, and blocks or is dropped; nothing is blessed."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import Finding, audit
from toolkit.geometry import Array
from toolkit.measurements import is_left_only
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import SCENARIOS, simulate


@cache
def drive() -> Sequence:
    return simulate(replace(SCENARIOS["drive"], duration_s=6.0), 4)


def with_pixels(change: Callable[[Array], Array]) -> Sequence:
    seen = drive().observations
    return replace(drive(), observations=Observations(seen.frame, seen.track_id, change(seen.uv_px.copy())))


def with_twists(values: Array) -> Sequence:
    return replace(drive(), motion=drive().motion.of(drive().motion.t_ns, values))


def found(sequence: Sequence) -> dict[str, Finding]:
    return {finding.fault: finding for finding in audit(sequence).findings}


def test_missing_sightings_written_as_zeros_are_dropped_and_the_rest_stays_sound() -> None:
    seen = drive().observations
    frame, track_id = (np.concatenate([part, part]) for part in (seen.frame, seen.track_id))
    zeros = Observations.sorted(frame, track_id, np.concatenate([seen.uv_px, np.zeros_like(seen.uv_px)]))
    reported = found(replace(drive(), observations=zeros))
    assert reported["swapped-coordinates"].repaired
    assert not any(finding.blocking for finding in reported.values())
    assert "missing ones, written as 0" in reported["swapped-coordinates"].detail
    assert "with which the recording is another one" not in reported["swapped-coordinates"].detail


def test_one_camera_in_the_place_of_both_is_not_called_an_exchange() -> None:
    finding = found(with_pixels(lambda uv_px: uv_px[:, [0, 0, 2]]))["swapped-coordinates"]
    assert finding.blocking
    assert "one camera's columns stand for both" in finding.detail
    assert "exchanged" not in finding.detail


def test_normalised_image_coordinates_are_named() -> None:
    rig = drive().rig
    centre = np.array([rig.cx_px, rig.cx_px, rig.cy_px])
    finding = found(with_pixels(lambda uv_px: (uv_px - centre) / rig.fx_px))["intrinsics"]
    assert finding.blocking
    assert "normalised image coordinates" in finding.detail


def test_stamps_that_run_backwards_are_never_cut_to_a_few_frames() -> None:
    """Uneven steps make some of them look like jumps of a clock that goes on."""
    rng = np.random.default_rng(2)
    t_ns = drive().frames_t_ns + rng.integers(0, 8_000_000, drive().frame_count)
    backwards = replace(drive(), frames_t_ns=t_ns[::-1], motion=drive().motion.of(t_ns[::-1], drive().motion.values))
    finding = found(backwards)["time-order"]
    assert finding.blocking
    assert "time runs backwards" in finding.detail


def test_velocities_of_the_wrong_sign_block_with_their_angle() -> None:
    finding = found(with_twists(drive().motion.values * np.repeat([-1.0, 1.0], 3)))["disagreement"]
    assert finding.blocking
    assert "velocity points 180 degrees away" in finding.detail or "velocity points 179 degrees" in finding.detail


def test_odometry_that_is_zero_all_along_accuses_nothing_else() -> None:
    reported = found(with_twists(np.zeros_like(drive().motion.values)))
    assert reported["stuck-samples"].blocking
    assert "velocities are zero while the camera moves" in reported["stuck-samples"].detail
    assert not reported.keys() & {"mixed-axes", "extrinsic-translation", "disagreement", "lever-arm", "conflict"}


@pytest.mark.parametrize("factor", [3.45, 3.6])
def test_a_speed_between_two_units_names_them(factor: float) -> None:
    reported = found(with_twists(drive().motion.values * np.repeat([factor, 1.0], 3)))
    messages = reported["units"] if "units" in reported else reported["disagreement"]
    assert "km/h" in messages.detail


def test_a_speed_in_knots_is_named_and_not_converted() -> None:
    finding = found(with_twists(drive().motion.values * np.repeat([1.944, 1.0], 3)))["disagreement"]
    assert finding.blocking
    assert "as if in knots" in finding.detail


def test_rates_in_turns_a_minute_are_named_and_not_converted() -> None:
    finding = found(with_twists(drive().motion.values * np.repeat([1.0, 30.0 / np.pi], 3)))["disagreement"]
    assert finding.blocking
    assert "as if in turns a minute" in finding.detail


@pytest.mark.parametrize("factor", [10.0, 1.0 / 60.0])
def test_stamps_in_another_unit_than_seconds_accuse_neither_speeds_nor_axes(factor: float) -> None:
    t_ns = drive().frames_t_ns[0] + np.rint((drive().frames_t_ns - drive().frames_t_ns[0]) * factor).astype(np.int64)
    reported = found(replace(drive(), frames_t_ns=t_ns, motion=drive().motion.of(t_ns, drive().motion.values)))
    assert reported["units"].blocking
    match = re.search(r"the stamps run (\S+) times as fast as time", reported["units"].detail)
    assert match is not None
    assert float(match[1]) == pytest.approx(factor, rel=0.02)
    assert not reported.keys() & {"mixed-axes", "disagreement", "lever-arm", "conflict"}


def test_stamps_rounded_to_seconds_are_reported_to_be_rounded() -> None:
    t_ns = np.asarray(np.round(drive().frames_t_ns / 1e9) * 1e9, dtype=np.int64)
    finding = found(replace(drive(), frames_t_ns=t_ns, motion=drive().motion.of(t_ns, drive().motion.values)))
    assert finding["time-order"].blocking
    assert "as stamps are that were rounded" in finding["time-order"].detail


@pytest.mark.parametrize("filler", [-999.0, -1.0, 0.0])
def test_missing_sightings_written_as_one_value_are_no_camera_in_the_place_of_both(filler: float) -> None:
    seen = drive().observations
    frame, track_id = (np.concatenate([part, part]) for part in (seen.frame, seen.track_id))
    pixels = np.concatenate([seen.uv_px, np.full_like(seen.uv_px, filler)])
    reported = found(replace(drive(), observations=Observations.sorted(frame, track_id, pixels)))
    assert reported["swapped-coordinates"].repaired
    assert f"missing ones, written as {filler:g}" in reported["swapped-coordinates"].detail


@pytest.mark.parametrize("filler", [-1.0, 0.0, 9999.0])
def test_missing_right_images_written_as_one_value_become_sightings_by_the_left_one(filler: float) -> None:
    missing = np.random.default_rng(0).uniform(size=len(drive().observations)) < 0.2

    def filled(uv_px: Array) -> Array:
        uv_px[missing, 1] = filler
        return uv_px

    outcome = audit(with_pixels(filled))
    reported = {finding.fault: finding for finding in outcome.findings}
    assert reported.keys() == {"swapped-coordinates", "left-only"}
    assert reported["swapped-coordinates"].repaired
    assert (
        f"{missing.sum()} of {missing.size} sightings have a uR of {filler:g}" in reported["swapped-coordinates"].detail
    )
    np.testing.assert_array_equal(is_left_only(outcome.sequence.observations.uv_px), missing)


def test_what_both_images_lack_is_no_sighting_by_the_left_one() -> None:
    seen = drive().observations
    right, both = (np.arange(len(seen)) % 20 == place for place in (0, 1))
    uv_px = np.where(both[:, None], -1.0, seen.uv_px)
    uv_px[right, 1] = -1.0
    kept = audit(with_pixels(lambda _: uv_px)).sequence.observations.uv_px
    assert (len(kept), is_left_only(kept).sum()) == (len(seen) - both.sum(), right.sum())


def test_right_images_rounded_to_pixels_are_none_that_are_missing() -> None:
    assert "swapped-coordinates" not in found(with_pixels(np.round))


def test_velocities_or_rates_that_are_zero_all_along_are_distinguished() -> None:
    for columns, words in (([1.0, 0.0], "rates of rotation are zero"), ([0.0, 1.0], "velocities are zero")):
        reported = found(with_twists(drive().motion.values * np.repeat(columns, 3)))
        assert reported["stuck-samples"].blocking
        assert words in reported["stuck-samples"].detail
        assert not reported.keys() & {"mixed-axes", "disagreement", "lever-arm", "conflict"}


def test_a_column_of_nan_is_named_and_no_sample_is_reported_to_be_zero() -> None:
    values = drive().motion.values.copy()
    values[:, 1] = np.nan
    reported = found(with_twists(values))
    assert reported["not-finite"].blocking
    assert "velocity y in all of them" in reported["not-finite"].detail
    assert not reported.keys() & {"stuck-samples", "outside-motion", "units"}


def test_images_exchanged_for_a_time_come_back_as_they_were() -> None:
    seen = drive().observations
    then = (seen.frame >= drive().frame_count // 3) & (seen.frame < 2 * drive().frame_count // 3)
    swapped = np.where(then[:, None], seen.uv_px[:, [1, 0, 2]], seen.uv_px)
    outcome = audit(with_pixels(lambda _: swapped))
    finding = next(finding for finding in outcome.findings if finding.fault == "swapped-coordinates")
    assert finding.repaired
    assert "whole frames" in finding.detail
    np.testing.assert_array_equal(outcome.sequence.observations.uv_px, seen.uv_px)


def test_frames_by_another_clock_altogether_are_not_cut_off_to_nothing() -> None:
    finding = found(replace(drive(), frames_t_ns=drive().frames_t_ns // 1000))["outside-motion"]
    assert finding.blocking
    assert "stamp both by one clock" in finding.detail


@pytest.mark.parametrize("begin, end", [(0.0, 0.3), (0.2, 0.8), (0.6, 1.0)], ids=["beginning", "middle", "end"])
@pytest.mark.parametrize("scenario", ["drive", "flight"])
def test_a_camera_that_freezes_for_longer_than_tracks_last_is_named(scenario: str, begin: float, end: float) -> None:
    sequence = simulate(replace(SCENARIOS[scenario], duration_s=8.0), 4)
    first, last = (int(share * (sequence.frame_count - 1)) for share in (begin, end))
    seen = sequence.observations
    here, rest = np.flatnonzero(seen.frame == first), np.flatnonzero((seen.frame <= first) | (seen.frame > last))
    repeats = last - first
    rows = np.concatenate([rest, np.tile(here, repeats)])
    frame = np.concatenate([seen.frame[rest], np.repeat(np.arange(first + 1, last + 1), here.size)])
    frozen = replace(sequence, observations=Observations.sorted(frame, seen.track_id[rows], seen.uv_px[rows]))
    finding = found(frozen)["stale-frames"]
    assert finding.blocking
    assert finding.count == repeats


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0])
def test_a_focal_length_of_the_rows_unlike_that_of_the_columns_is_named(factor: float) -> None:
    flight = simulate(replace(SCENARIOS["flight"], duration_s=6.0), 4)
    finding = found(replace(flight, rig=replace(flight.rig, fy_px=factor * flight.rig.fy_px)))["intrinsics"]
    assert finding.blocking
    assert "beside fx_px" in finding.detail
