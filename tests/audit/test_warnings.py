"""Warnings: told where they are planted and of the size they have, and of nothing in sound recordings."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.agreement import Deviation, sustained
from toolkit.audit.alignment import Turn, velocity_fit
from toolkit.audit.calibration import lever_arm
from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.tracks import track_scatter
from toolkit.geometry import Array, interpolate_poses, se3, se3_inverse, so3_exp, transform
from toolkit.models.noise import TRACKED_PIXEL_SIGMA_PX
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_sound_recording_warns_of_nothing(scenario: str, seed: int) -> None:
    findings = audit(simulate(replace(SCENARIOS[scenario], duration_s=8.0), seed)).findings
    assert not any(finding.warning or finding.blocking for finding in findings)
    assert [finding.fault for finding in findings] == ["correlated-tracks"] * ("realistic" in scenario)


def test_a_conflict_is_reported_at_its_time_and_of_its_size() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 3)
    disturbed = faults.disturbed_motion(sound, 3.0, 3)
    off = np.flatnonzero(np.any(disturbed.motion.values != sound.motion.values, axis=1))
    begin_s, end_s = (disturbed.motion.t_ns[off[[0, -1]]] - sound.frames_t_ns[0]) / 1e9
    (found,) = (finding for finding in audit(disturbed).findings if finding.fault == "conflict")
    match = re.search(r"at (\d+)-(\d+) s \(by ([\d.]+) m/s", found.detail)
    assert match is not None
    # Whole seconds, and a quarter of the stretch of 2 s at either end.
    assert [float(match[1]), float(match[2])] == pytest.approx([begin_s, end_s], abs=1.0)
    assert float(match[3]) == pytest.approx(3.0, abs=0.15)
    assert found.warning and not found.blocking and not found.repaired


def test_what_scatters_all_along_is_no_conflict_and_what_stands_out_is() -> None:
    rng, t_s = np.random.default_rng(0), 0.1 * np.arange(600)
    wander = np.repeat(rng.normal(0.0, 0.5, (30, 3)), 20, axis=0)  # lasts 2 s each, as slip does
    value = wander + rng.normal(0.0, 0.05, (600, 3))
    noise = np.full(3, 0.06)
    assert sustained(Deviation("velocity", "m/s", t_s, value, noise, False), 10.0, 0.2) == []
    value[300:350] += np.array([9.0, 0.0, 0.0])
    (span,) = sustained(Deviation("velocity", "m/s", t_s, value, noise, False), 10.0, 0.2)
    assert (span.begin_s, span.end_s) == pytest.approx((30.0, 35.0), abs=1.0)


def test_a_conflict_that_begins_in_the_middle_and_stays_is_no_usual_scatter() -> None:
    rng, t_s = np.random.default_rng(1), 0.1 * np.arange(600)
    value = rng.normal(0.0, 0.05, (600, 3))
    value[300:] += np.array([1.0, 0.0, 0.0])
    (span,) = sustained(Deviation("velocity", "m/s", t_s, value, np.full(3, 0.06), False), 10.0, 0.2)
    assert span.begin_s == pytest.approx(30.0, abs=1.0)


def test_the_turn_of_a_camera_is_measured_about_the_axes_that_the_motion_determines() -> None:
    """A car drives ahead: its velocity tells pitch and yaw, and nothing of the roll."""
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 3)
    intervals, T_imu_cam = Evidence(sound).intervals, sound.rig.T_imu_cam
    assert intervals is not None
    turned = se3(so3_exp(np.array([0.3, 0.03, -0.04])), np.zeros(3)) @ T_imu_cam
    turned[:3, 3] = T_imu_cam[:3, 3]

    def turn_of(T_imu_cam: Array) -> Turn:
        assert intervals is not None and intervals.v_mps is not None
        return velocity_fit(intervals._replace(T_imu_cam=T_imu_cam), np.inf).turn

    found = turn_of(turned)
    assert found.rad.size == 2
    # Five of its standard errors, about 0.001 rad, and what the roll turns the sides into each other.
    assert np.linalg.norm(found.rad) == pytest.approx(0.05, abs=0.01)
    assert (np.abs(turn_of(T_imu_cam).rad) < 0.006).all()


def test_a_turned_camera_is_reported_on_five_seconds_of_a_drive() -> None:
    """Three stretches as long as slip lasts tell little of their own scatter; what real odometry has helps them out."""
    sound = simulate(replace(SCENARIOS["drive"], duration_s=5.0), 2)
    assert "miscalibration" not in found_in(sound)
    assert "as if it were turned by" in found_in(faults.turned_camera(sound, 0.1, 2))["miscalibration"]


def found_in(sequence: Sequence) -> dict[str, str]:
    """Return what the audit says of each fault that it finds and does not repair."""
    return {finding.fault: finding.detail for finding in audit(sequence).findings if not finding.repaired}


def test_vision_that_is_too_long_beside_odometry_is_reported_with_its_error() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 4)
    (reported,) = found_in(faults.stretched_disparity(sound, 1.06)).values()
    match = re.search(r"vision's steps are ([\d.]+) \+- ([\d.]+) % shorter than the odometry's", reported)
    assert match is not None
    # 1 - 1 / 1.06 is 5.7 %; the tracks' noise makes half a percent of bias.
    assert float(match[1]) == pytest.approx(5.7, abs=1.0)
    assert float(match[2]) < 0.6


@pytest.mark.parametrize("seed", [515, 803])
def test_a_camera_in_its_place_is_not_accused_by_the_errors_that_last(seed: int) -> None:
    """A regression from frame to frame over these five seconds has it 0.2 m off, by eight of its standard errors."""
    evidence = Evidence(simulate(replace(SCENARIOS["flight-realistic"], duration_s=5.0, varied=True), seed))
    assert lever_arm(evidence) is None


def test_a_camera_a_quarter_of_a_metre_from_its_place_is_reported_beside_an_imu() -> None:
    sound = simulate(replace(SCENARIOS["flight-realistic"], duration_s=5.0), 102)
    assert isinstance(lever_arm(Evidence(faults.displaced_camera(sound, 0.25))), Symptom)


def test_scale_and_lever_arm_are_measured_within_their_errors() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=20.0), 5)
    faulty = faults.displaced_camera(faults.stretched_disparity(sound, 1.1), 0.5, 1)
    found = Evidence(faulty).velocity_fit
    assert found is not None
    missing = sound.rig.T_imu_cam[:3, 3] - faulty.rig.T_imu_cam[:3, 3]
    # Four standard errors, and 1 % that the tracks' noise shortens the camera's motion by.
    assert found.scale.value == pytest.approx(1.0 / 1.1 - 1.0, abs=4.0 * found.scale.error + 0.01)
    assert (np.abs(found.position.lacking_m - missing) < 4.0 * found.position.error_m).all()
    assert found.position.error_m[0] < 0.1


def test_a_scale_that_the_recording_hardly_shows_says_how_large_a_fault_it_hides() -> None:
    """What is a little larger is told, whichever way, and two percent are not blessed."""
    sound = simulate(replace(SCENARIOS["flight"], duration_s=20.0), 5)
    hidden = re.search(r"less than (\S+) % would not show", audit(sound).undecided["vision-scale"])
    assert hidden is not None
    assert 2.0 < float(hidden[1]) < 5.0
    for sign in (1.0, -1.0):
        beyond = float(np.exp(sign * (0.01 * float(hidden[1]) + 0.003)))  # the windows' own change of the estimate
        assert "baseline" in found_in(faults.baseline_unit(sound, beyond))["miscalibration"]
    assert "would not show" in audit(faults.stretched_disparity(sound, 1.02)).undecided["vision-scale"]


def test_a_camera_that_is_elsewhere_is_reported_and_one_that_hardly_turns_is_not_checked() -> None:
    sound = simulate(replace(SCENARIOS["flight"], duration_s=12.0), 6)
    T_imu_cam = sound.rig.T_imu_cam.copy()
    T_imu_cam[1, 3] += 0.5
    reported = found_in(replace(sound, rig=replace(sound.rig, T_imu_cam=T_imu_cam)))
    assert re.search(r"the camera is off by -0\.[45]\d \+- 0\.\d\d m along y", reported["lever-arm"])
    straight = simulate(replace(SCENARIOS["drive-imu"], duration_s=6.0), 6)
    assert "too little rotation" in audit(straight).undecided["lever-arm"]
    assert "too little change of velocity" in audit(straight).undecided["vision-scale"]


def test_tracks_that_scatter_more_than_their_noise_are_reported_and_a_tenth_of_mismatches_is_not() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=8.0), 7)
    assert set(found_in(faults.outlier_tracks(sound, 0.6, 7))) == {"track-scatter", "correlated-tracks"}
    match = re.search(r"scatter ([\d.]+) \+-", found_in(faults.wrong_noise(sound, 1.0 / 3.0))["track-scatter"])
    assert match is not None
    assert float(match[1]) == pytest.approx(3.0, abs=0.1)
    assert found_in(faults.outlier_tracks(sound, 0.05, 7)) == {}


@pytest.mark.parametrize(("scenario", "duration_s"), [("drive", 12.0), ("flight", 6.0)])
def test_a_tenth_of_tracks_that_slide_is_reported_where_the_noise_is_right(scenario: str, duration_s: float) -> None:
    sound = simulate(replace(SCENARIOS[scenario], duration_s=duration_s), 9)
    match = re.search(r"frame ([\d.]+)% \+- ([\d.]+)%", found_in(faults.outlier_tracks(sound, 0.1, 9))["track-scatter"])
    assert match is not None
    assert 1.0 < float(match[1]) < 10.0  # some slide by less than four standard deviations a frame
    # With twice the noise stated they are beneath it.
    beneath = scatter_of(faults.outlier_tracks(faults.wrong_noise(sound, 2.0), 0.1, 9))
    assert beneath is None or ("times too large" in beneath and "have residuals of more than" not in beneath)


def scatter_of(sequence: Sequence) -> str | None:
    found = track_scatter(Evidence(sequence))
    assert found is None or (isinstance(found, Symptom) and found.warns)
    return found and f"{found.detail}; {found.treatment}"


@pytest.mark.parametrize("scenario", ["drive", "flight", "drive-imu"])
@pytest.mark.parametrize("seed", [11, 12])
def test_a_pixel_noise_stated_too_large_or_too_small_is_reported_with_its_ratio(scenario: str, seed: int) -> None:
    sound = simulate(replace(SCENARIOS[scenario], duration_s=6.0), seed)
    assert scatter_of(sound) is None
    assert scatter_of(faults.wrong_noise(sound, 1.3)) is None
    for dose in (2.0, 5.0, 30.0):
        match = re.search(r"stated ([\d.]+) times too large", scatter_of(faults.wrong_noise(sound, dose)) or "")
        assert match is not None
        assert float(match[1]) == pytest.approx(dose, rel=0.06)
        match = re.search(r"stated ([\d.]+) times too small", scatter_of(faults.wrong_noise(sound, 1.0 / dose)) or "")
        assert match is not None
        assert float(match[1]) == pytest.approx(dose, rel=0.06)


def test_of_tracks_whose_errors_go_together_only_a_noise_far_too_large_is_reported_and_by_how_much_at_most() -> None:
    """The steps of tracks that drift are smaller than their errors: 30 times too much looks like more."""
    sound = simulate(replace(SCENARIOS["flight-realistic"], duration_s=5.0), 11)
    assert scatter_of(sound) is None
    match = re.search(r"by less than (\d+) times", scatter_of(faults.wrong_noise(sound, 30.0)) or "")
    assert match is not None
    assert float(match[1]) > 30.0


def test_half_a_pixel_that_is_assumed_and_too_much_is_reported_for_information() -> None:
    """It is what the toolkit takes tracks to have of which nobody says more, and no fault of a recording."""
    sound = simulate(replace(SCENARIOS["drive"], duration_s=6.0), 11)
    sigma_px, assumed_px2 = 0.1, TRACKED_PIXEL_SIGMA_PX**2 * np.diag([1.0, 1.0, 0.5])
    truth = sound.truth
    assert truth is not None
    T_world_cam = interpolate_poses(truth.t_ns, truth.T_world_imu, sound.frames_t_ns) @ sound.rig.T_imu_cam
    uv_px = exactly_seen(sound, T_world_cam)
    uv_px += np.random.default_rng(0).normal(0.0, sigma_px, uv_px.shape) * np.sqrt([1.0, 1.0, 0.5])
    observations = replace(sound.observations, uv_px=uv_px)
    found = track_scatter(Evidence(replace(
        sound, observations=observations, rig=replace(sound.rig, cov_uv_px2=assumed_px2)
    )))  # fmt: skip
    assert isinstance(found, Symptom)
    assert not found.warns
    assert "stated 5.1 times too large" in found.treatment
    assert "half a pixel is assumed" in found.treatment


def test_tracks_without_errors_refute_no_noise() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=5.0), 11)
    observations, truth = sound.observations, sound.truth
    assert truth is not None
    T_world_cam = interpolate_poses(truth.t_ns, truth.T_world_imu, sound.frames_t_ns) @ sound.rig.T_imu_cam
    exact = replace(observations, uv_px=exactly_seen(sound, T_world_cam))
    assert scatter_of(replace(sound, observations=exact)) is None


def exactly_seen(sequence: Sequence, T_world_cam: Array) -> Array:
    """Return where each track's point, as it was first triangulated, is seen (N, 3) without any error."""
    seen = sequence.observations
    points = transform(T_world_cam[seen.frame], triangulate(seen.uv_px, sequence.rig))
    _, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    return project(transform(se3_inverse(T_world_cam)[seen.frame], points[first][row]), sequence.rig)


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        ([0, 1, 2, 3, 5, 4], "the gyro's x, y, z are the extrinsic's x, z, y, so no"),
        ([0, 1, 2, 5, 4, 3], "the gyro's x, y, z are the extrinsic's z, y, x, so no"),
        ([1, 0, 2, 3, 4, 5], "the gyro agrees with the camera and the velocities do not"),
    ],
)
def test_channels_that_are_exchanged_are_named_and_no_turn_of_the_extrinsic_is_taken(
    channels: list[int], expected: str
) -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 8)
    exchanged = sound.motion.of(sound.motion.t_ns, sound.motion.values[:, channels])
    reported = found_in(replace(sound, motion=exchanged))["mixed-axes"]
    assert expected in reported


def test_a_unit_that_holds_for_half_of_a_recording_is_reported_and_not_converted() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 8)
    values = sound.motion.values.copy()
    values[len(values) // 2 :, 3:] *= 180.0 / np.pi
    half = replace(sound, motion=sound.motion.of(sound.motion.t_ns, values))
    assert "deg/s in a part of the recording" in found_in(half)["units"]


def test_feet_are_no_kilometres_an_hour() -> None:
    sound = simulate(replace(SCENARIOS["drive"], duration_s=12.0), 8)
    (unit,) = (f.detail for f in audit(faults.linear_unit(sound, 3.281)).findings if f.fault == "units")
    assert "it is in ft/s" in unit
    assert "units" not in found_in(faults.linear_unit(sound, 3.43))  # half-way between the two: nobody's


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("scenario", "duration_s", "dose"), [("flight", 6.0, 1.1), ("drive-imu", 12.0, 1.05), ("drive", 12.0, 1.1)]
)
def test_a_gyro_that_turns_too_fast_is_reported_with_the_ratio(
    scenario: str, duration_s: float, dose: float, seed: int
) -> None:
    sound = simulate(replace(SCENARIOS[scenario], duration_s=duration_s, varied=seed % 2 == 1), 60 + seed)
    assert "miscalibration" not in found_in(sound)
    match = re.search(
        r"turns ([\d.]+) \+- ([\d.]+) times as fast", found_in(faults.angular_unit(sound, dose))["miscalibration"]
    )
    assert match is not None
    # The noise of the camera's rotation lowers the ratio by up to 1.5 %.
    assert float(match[1]) == pytest.approx(dose, abs=0.015 + 3.0 * float(match[2]))


@pytest.mark.parametrize("every", [4, 5])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_frames_without_a_sighting_now_and_then_leave_too_little_to_compare_and_no_warning_of_numpy(every: int) -> None:
    """No stretch of intervals is long enough for the specific force between its holes."""
    sequence = simulate(replace(SCENARIOS["drive-imu"], duration_s=8.0), 0)
    seen = sequence.observations.frame % every != 0
    findings = audit(replace(sequence, observations=sequence.observations.select(seen))).findings
    assert "conflict" not in {finding.fault for finding in findings}
