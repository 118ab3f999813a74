"""Every injector does what its docstring says, to nothing else, and the same under the same seed."""

from dataclasses import replace
from inspect import getmembers, isfunction

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry import so3_exp
from toolkit.models.stereo import CHANNELS, triangulate
from toolkit.sequence import Sequence, check_runnable
from toolkit.simulation import SCENARIOS, faults, simulate

INJECTORS = {
    name: function
    for name, function in getmembers(faults, isfunction)
    if function.__module__ == faults.__name__ and not name.startswith("_") and name != "planted"
}
# What an estimator is not given without a repair or a refusal first.
NOT_RUNNABLE = {"nan_span", "clock_jump"}


@pytest.fixture(scope="module")
def drive() -> Sequence:
    return simulate(replace(SCENARIOS["drive"], duration_s=6.0), 0)


@pytest.mark.parametrize("name", INJECTORS)
def test_a_fault_changes_a_copy_in_the_same_way_under_the_same_seed(name: str, drive: Sequence) -> None:
    before = drive.content_hash()
    once, again = (INJECTORS[name](drive, seed=4) for _ in range(2))
    assert once.content_hash() == again.content_hash() != before
    assert drive.content_hash() == before


@pytest.mark.parametrize("name", faults.INJECTORS)
def test_the_clean_dose_of_a_fault_leaves_a_recording_as_it_is(name: str, drive: Sequence) -> None:
    clean = faults.INJECTORS[name].plant(drive, faults.INJECTORS[name].clean, 4)
    assert clean.content_hash(12) == drive.content_hash(12)  # but for rounding


@pytest.mark.parametrize("name", sorted(INJECTORS.keys() - NOT_RUNNABLE))
def test_what_remains_can_be_run(name: str, drive: Sequence) -> None:
    check_runnable(INJECTORS[name](drive, seed=1))


def test_a_rolled_right_camera_sees_what_one_turned_about_its_optical_axis_sees(drive: Sequence) -> None:
    rig, uv_px = drive.rig, drive.observations.uv_px
    rolled = faults.rolled_right(drive, 0.02, 0).observations.uv_px
    points = triangulate(uv_px, rig) - [rig.baseline_m, 0.0, 0.0]
    seen = points @ so3_exp(np.array([0.0, 0.0, 0.02]))
    across, down = (seen[:, :2] / seen[:, 2:]).T
    expected = np.stack([uv_px[:, 0], rig.cx_px + rig.fx_px * across, rig.cy_px + rig.fy_px * down], axis=1)
    expected[:, 2] = 0.5 * (uv_px[:, 2] + expected[:, 2])
    np.testing.assert_allclose(rolled, expected, atol=1e-9)


def test_a_blackout_ends_every_track(drive: Sequence) -> None:
    dark = faults.blackout(drive, 1.0, 0)
    empty = np.setdiff1d(np.arange(drive.frame_count), dark.observations.frame)
    assert empty.size == 10
    seen = dark.observations
    assert np.intersect1d(seen.track_id[seen.frame < empty[0]], seen.track_id[seen.frame > empty[-1]]).size == 0


def test_few_tracks_last_as_long_as_they_did(drive: Sequence) -> None:
    few = faults.few_tracks(drive, 3, 0).observations
    assert np.bincount(few.frame, minlength=drive.frame_count).tolist() == [3] * drive.frame_count
    spans = [np.ptp(few.frame[few.track_id == i]) + 1 for i in np.unique(few.track_id)]
    assert sum(spans) == len(few)


def test_a_vehicle_that_stands_goes_on_later_where_it_was(drive: Sequence) -> None:
    halted = faults.standstill(drive, 2.0, 0)
    assert halted.frame_count == drive.frame_count + 20
    steps = np.linalg.norm(np.diff(halted.truth.T_world_imu[:, :3, 3], axis=0), axis=1)
    assert (steps == 0.0).sum() == 20
    np.testing.assert_array_equal(halted.truth.T_world_imu[-1], drive.truth.T_world_imu[-1])
    stands = np.linalg.norm(halted.motion.v_mps, axis=1) < 0.5  # 10 standard deviations; it drives at 3 m/s or more
    assert stands.sum() == 20
    assert len(halted.observations) > len(drive.observations)


def test_an_imu_cannot_be_stopped_without_braking() -> None:
    flight = simulate(replace(SCENARIOS["flight"], duration_s=1.0), 0)
    with pytest.raises(DataError, match="simulate a scene that halts"):
        faults.standstill(flight, 1.0, 0)


def test_a_walk_grows_with_the_root_of_the_age_and_an_offset_stays(drive: Sequence) -> None:
    seen = drive.observations
    _, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    age = seen.frame - seen.frame[first][row]
    walked_px = (faults.track_walk(drive, 0.2, 1).observations.uv_px - seen.uv_px) @ CHANNELS.T
    assert not walked_px[age == 0].any()
    for frames in (1, 4, 9):
        # Some hundred tracks are as old: 10 % is three standard errors and more.
        spread = walked_px[age == frames].std()
        assert spread == pytest.approx(0.2 * np.sqrt(frames), rel=0.1)
    off_px = (faults.match_offset(drive, 0.7, 1).observations.uv_px - seen.uv_px) @ CHANNELS.T
    assert np.abs(off_px - off_px[first][row]).max() < 1e-9
    assert off_px[first].std(axis=0) == pytest.approx([0.0, 0.7, 0.0], rel=0.1, abs=1e-9)


def test_moving_objects_move_a_share_of_the_tracks_and_keep_their_first_sightings(drive: Sequence) -> None:
    moved = faults.moving_vehicles(drive, 0.2, 3).observations
    rows = np.isin(
        drive.observations.frame * 100_000 + drive.observations.track_id, moved.frame * 100_000 + moved.track_id
    )
    shift_px = np.abs(moved.uv_px - drive.observations.uv_px[rows]).max(axis=1)
    first = np.unique(moved.track_id, return_index=True)[1]
    assert shift_px[first].max() < 1e-6
    struck = np.unique(moved.track_id[shift_px > 1e-6])
    lasting = np.unique(moved.track_id, return_counts=True)[1] > 1
    assert struck.size / lasting.sum() == pytest.approx(0.2, abs=0.04)
    with pytest.raises(DataError, match="need the truth"):
        faults.moving_vehicles(replace(drive, truth=None))
