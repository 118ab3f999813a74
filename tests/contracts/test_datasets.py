"""What holds for every recording, whatever its source: one list of properties, run over all of them."""

import os
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets import built_in_names, load_sequence
from toolkit.sequence import Sequence
from toolkit.verify import arrays_of

PROJECT = Path(__file__).parents[2]
DATA = PROJECT / os.environ.get("VISLAM_DATA", "../shared/data")
REAL = (
    *("ucsd/03.npz", "ucsd/0027.npz", "ucsd/10_imu_only.npz", "utias/dataset3.mat"),
    *("utias/2011_09_26_drive_0035_sync_KLT.mat", "openvins_sim/udel_gore_rect_s0"),
    *("euroc/V1_01_easy", "euroc/V2_01_easy"),
)
SEED = 3


def loaded(source: str) -> Sequence:
    if source in built_in_names():
        return load_sequence(source, SEED)
    if not (DATA / source).exists():
        pytest.skip(f"needs the real data {source} under VISLAM_DATA")
    return load_sequence(str(DATA / source))


@pytest.fixture(scope="module", params=(*built_in_names(), *REAL))
def source(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def sequence(source: str) -> Sequence:
    return loaded(source)


def test_sightings_are_finite_and_sorted_by_frame_then_track_without_repeats(sequence: Sequence) -> None:
    seen = sequence.observations
    frames_on, ids_on = np.diff(seen.frame), np.diff(seen.track_id)
    assert ((frames_on > 0) | ((frames_on == 0) & (ids_on > 0))).all()
    assert seen.frame.dtype == seen.track_id.dtype == sequence.frames_t_ns.dtype == np.int64
    assert ((seen.frame >= 0) & (seen.frame < sequence.frame_count)).all()
    assert (seen.track_id >= 0).all()
    assert np.isfinite(seen.uv_px).all()


def test_packets_can_be_read_and_nothing_can_be_written(sequence: Sequence) -> None:
    assert np.isfinite(sequence.motion.values).all()
    assert sum(1 for _ in sequence.packets()) == sequence.frame_count
    few = [array for packet in islice(sequence.packets(), 5) for array in arrays_of(packet)]
    for array in (
        *few,
        sequence.frames_t_ns,
        sequence.observations.uv_px,
        sequence.motion.t_ns,
        sequence.rig.T_imu_cam,
    ):
        assert not array.flags.writeable


def test_calibration_and_noise_are_usable(sequence: Sequence) -> None:
    rig = sequence.rig
    assert min(rig.fx_px, rig.fy_px, rig.baseline_m) > 0.0
    assert (np.linalg.eigvalsh(rig.cov_uv_px2) > 0.0).all()
    R_imu_cam = rig.T_imu_cam[:3, :3]
    # published calibrations carry nine digits or fewer
    np.testing.assert_allclose(R_imu_cam @ R_imu_cam.T, np.eye(3), atol=1e-6)
    densities = np.concatenate([np.ravel(density) for density in vars(sequence.noise).values()])
    assert (densities > 0.0).all()


def test_the_truth_covers_frames_with_rigid_motions(sequence: Sequence) -> None:
    truth = sequence.truth
    if truth is None:
        return
    assert (np.diff(truth.t_ns) > 0).all()
    assert truth.t_ns[0] <= sequence.frames_t_ns[-1]
    assert truth.t_ns[-1] >= sequence.frames_t_ns[0]
    R_world_imu = truth.T_world_imu[:, :3, :3]
    # twelve-digit quaternions
    np.testing.assert_allclose(
        R_world_imu @ np.swapaxes(R_world_imu, 1, 2), np.broadcast_to(np.eye(3), R_world_imu.shape), atol=1e-9
    )


def test_loading_twice_gives_the_same_content_and_says_whence(source: str, sequence: Sequence) -> None:
    assert loaded(source).content_hash() == sequence.content_hash()
    assert all((sequence.name, sequence.provenance.format, sequence.provenance.source))
