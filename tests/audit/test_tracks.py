"""Faults of the tracks: rounding, missing right images, correlated errors, and a noise that is stated wrongly."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import recording, unrepaired, with_pixels
from toolkit.audit import audit
from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.tracks import coarse_pixels, track_scatter
from toolkit.datasets import own_tables
from toolkit.geometry import interpolate_poses, se3_inverse, transform
from toolkit.models.noise import TRACKED_PIXEL_SIGMA_PX
from toolkit.models.stereo import CHANNELS, project, triangulate
from toolkit.sequence import Sequence
from toolkit.simulation import faults
from toolkit.simulation.sensors import TrackNoise, with_track_noise


@pytest.mark.parametrize("step_px", [1.0, 0.5, 0.1])
def test_the_step_of_rounded_pixels_adds_its_root_of_a_twelfth(step_px: float) -> None:
    sound = recording("drive")
    uv_px = np.round(sound.observations.uv_px / step_px) * step_px
    uv_px[::7, 1] = np.nan  # without a right image
    found = coarse_pixels(Evidence(with_pixels(sound, uv_px)))
    assert isinstance(found, Symptom) and not found.warns
    assert f"multiples of {step_px:g} px: rounding adds errors of {step_px / 12**0.5:.2g} px" in found.detail
    warned = coarse_pixels(Evidence(faults.wrong_noise(with_pixels(sound, uv_px), 0.15)))
    assert isinstance(warned, Symptom) and warned.warns == (step_px / 12**0.5 > 0.5 * 0.15)


def test_sightings_without_the_right_image_are_counted_and_left_and_warned_of_where_all_are() -> None:
    third = faults.missing_right(recording("drive"), 1.0 / 3.0, 0)
    outcome = audit(third)
    (finding,) = outcome.findings
    assert (finding.fault, finding.blocking, finding.repaired, finding.warning) == ("left-only", False, False, False)
    assert finding.count == np.isnan(third.observations.uv_px[:, 1]).sum()
    assert outcome.sequence is third
    everywhere = audit(faults.missing_right(recording("drive"), 1.0, 0)).findings
    assert "left-only" in {finding.fault for finding in everywhere if finding.warning}


@pytest.mark.parametrize("rows", [("v",), ("vL", "vR")])
def test_rows_that_may_differ_are_not_decidable_where_one_stands_for_both(rows: tuple[str, ...]) -> None:
    sequence = recording("drive", 0, 4.0)
    seen, rig = sequence.observations, sequence.rig
    u_left, u_right, v = seen.uv_px.T
    tracks = {"t_ns": sequence.frames_t_ns[seen.frame], "track_id": seen.track_id, "uL": u_left, "uR": u_right}
    motion = dict(zip(own_tables.TWIST, sequence.motion.values.T, strict=True))
    numbers = {key: getattr(rig, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m")}
    table = {"t_ns": sequence.motion.t_ns, **motion}
    read = own_tables.read(
        "own", tracks | dict.fromkeys(rows, v), table, numbers | {"T_imu_cam": rig.T_imu_cam.tolist()}
    )
    assert ("unknown-rows" in audit(read.sequence).undecided) == (rows == ("v",))


@pytest.mark.parametrize("walk_px", [0.0, 1.0, 4.0])
def test_the_correlation_of_neighbouring_steps_is_that_of_white_noise_and_a_walk(walk_px: float) -> None:
    # No walk of the disparity: what that does to the depth, and so to later steps, theory leaves out.
    flight = recording("flight", 3, 4.0)
    walk = TrackNoise(np.zeros(3), walk_px * np.array([1.0, 0.0, 1.0]), np.zeros(3))
    observations = with_track_noise(flight.observations, walk, np.random.default_rng(3))
    to_pixels = np.linalg.inv(CHANNELS)
    walk_px2 = to_pixels @ np.diag(walk.walk_px**2) @ to_pixels.T  # of (uL, uR, v)
    expected = -1.0 / (2.0 + np.trace(np.linalg.solve(flight.rig.cov_uv_px2, walk_px2)) / 3.0)
    found = Evidence(replace(flight, observations=observations)).step_correlation
    assert found is not None
    # The camera's motion is fitted to the tracks and takes some of it: 0.04 at most under three seeds.
    assert found.value == pytest.approx(expected, abs=0.06)


def scatter_of(sequence: Sequence) -> str | None:
    found = track_scatter(Evidence(sequence))
    assert found is None or (isinstance(found, Symptom) and found.warns)
    return found and f"{found.detail}; {found.treatment}"


@pytest.mark.parametrize("scenario", ["drive", "flight", "drive-imu"])
def test_a_pixel_noise_stated_too_large_or_too_small_is_reported_with_its_ratio(scenario: str) -> None:
    sound = recording(scenario, 11)
    assert scatter_of(sound) is None
    assert scatter_of(faults.wrong_noise(sound, 1.3)) is None
    for dose in (2.0, 30.0):
        for stated, direction in ((dose, "large"), (1.0 / dose, "small")):
            reported = scatter_of(faults.wrong_noise(sound, stated)) or ""
            match = re.search(rf"stated ([\d.]+) times too {direction}", reported)
            assert match is not None
            assert float(match[1]) == pytest.approx(dose, rel=0.06)


def test_of_tracks_with_correlated_errors_only_a_noise_far_too_large_is_reported_with_a_bound() -> None:
    """The steps of tracks that drift are smaller than their errors: 30 times too much looks like more."""
    sound = recording("flight-realistic", 11, 5.0)
    assert scatter_of(sound) is None
    match = re.search(r"by less than (\d+) times", scatter_of(faults.wrong_noise(sound, 30.0)) or "")
    assert match is not None and float(match[1]) > 30.0


def test_mismatches_are_reported_and_a_few_are_not() -> None:
    sound = recording("drive", 7, 8.0)
    assert set(unrepaired(faults.outlier_tracks(sound, 0.6, 7))) == {"track-scatter"}
    assert unrepaired(faults.outlier_tracks(sound, 0.05, 7)) == {}
    overstated = faults.wrong_noise(sound, 2.0)
    assert "have residuals of more than" not in (scatter_of(overstated) or "")
    match = re.search(r"frame ([\d.]+)% \+-", unrepaired(faults.exchanged_tracks(overstated, 0.1, 1))["track-scatter"])
    # An exchanged sighting spoils the step to it and the one from it: nearly twice the share, less those lost as pairs.
    assert match is not None and 10.0 < float(match[1]) < 20.0


@pytest.mark.parametrize(("scenario", "duration_s"), [("drive", 12.0), ("flight", 6.0)])
def test_a_tenth_of_tracks_that_slide_is_reported_where_the_noise_is_right(scenario: str, duration_s: float) -> None:
    sound = recording(scenario, 9, duration_s)
    match = re.search(
        r"frame ([\d.]+)% \+- ([\d.]+)%", unrepaired(faults.outlier_tracks(sound, 0.1, 9))["track-scatter"]
    )
    # Some slide by less than four standard deviations a frame; with twice the noise stated they are beneath it.
    assert match is not None and 1.0 < float(match[1]) < 10.0
    beneath = scatter_of(faults.outlier_tracks(faults.wrong_noise(sound, 2.0), 0.1, 9))
    assert beneath is None or ("times too large" in beneath and "have residuals of more than" not in beneath)


def test_half_a_pixel_that_is_assumed_and_too_much_is_information_and_exact_tracks_refute_nothing() -> None:
    sound = recording("drive", 11)
    assert sound.truth is not None
    T_world_cam = interpolate_poses(sound.truth.t_ns, sound.truth.T_world_imu, sound.frames_t_ns) @ sound.rig.T_imu_cam
    seen = sound.observations
    points = transform(T_world_cam[seen.frame], triangulate(seen.uv_px, sound.rig))
    _, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    exact_px = project(transform(se3_inverse(T_world_cam)[seen.frame], points[first][row]), sound.rig)
    assert scatter_of(with_pixels(sound, exact_px)) is None
    noise_px = np.random.default_rng(0).normal(0.0, 0.1, exact_px.shape) * np.sqrt([1.0, 1.0, 0.5])
    assumed = replace(sound.rig, cov_uv_px2=TRACKED_PIXEL_SIGMA_PX**2 * np.diag([1.0, 1.0, 0.5]))
    found = track_scatter(Evidence(replace(with_pixels(sound, exact_px + noise_px), rig=assumed)))
    assert isinstance(found, Symptom) and not found.warns
    assert "stated 5 times too large" in found.treatment and "half a pixel is assumed" in found.treatment
