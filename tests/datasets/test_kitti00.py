"""The real KITTI 00 stretch of the gtsam wheel: size, conventions and noise."""

from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np
import pytest

from toolkit.datasets import kitti00, load_sequence
from toolkit.datasets.io.truth import load_truth, with_truth
from toolkit.errors import DataError
from toolkit.geometry import interpolate_poses, se3_inverse, transform
from toolkit.measurements import ImuNoise
from toolkit.models.noise import white_sigma
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Sequence


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return load_sequence("kitti00")


def test_it_holds_frames_14_to_153_that_have_tracks_and_an_imu_one_sample_longer_with_gravity_up(
    sequence: Sequence,
) -> None:
    assert sequence.frame_count == 121
    assert len(sequence.observations) == 77873
    assert np.unique(sequence.observations.track_id).size == 23099
    assert sequence.duration_s == pytest.approx(139 * 0.10366, abs=1e-6)
    assert sequence.truth is None
    t_ns, motion = sequence.frames_t_ns, sequence.motion
    assert ((motion.t_ns >= t_ns[0]) & (motion.t_ns <= t_ns[-1])).tolist() == [
        False,
        *[True] * (motion.t_ns.size - 2),
        False,
    ]
    np.testing.assert_allclose(motion.values[:, :3].mean(axis=0), [0.0, 0.0, 9.8], atol=0.5)


def test_the_stated_noise_covers_the_scatter_of_the_samples_only_as_densities(sequence: Sequence) -> None:
    assert isinstance(sequence.noise, ImuNoise)
    root_dt = 0.1  # 100 Hz
    scatter = white_sigma(sequence.motion.values) * root_dt
    assert scatter[:3].max() < sequence.noise.accel_noise_density
    assert scatter[3:].max() < sequence.noise.gyro_noise_density
    assert scatter[:3].min() > sequence.noise.accel_noise_density * root_dt
    assert scatter[3:].min() > sequence.noise.gyro_noise_density * root_dt


def test_tracks_fit_the_drive_s_truth(sequence: Sequence, real: Callable[[str], Path]) -> None:
    truth = with_truth(sequence, *load_truth(real("kitti00/gt_imu.tum"))).truth
    assert truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, sequence.frames_t_ns)
    seen, T_world_cam = sequence.observations, poses @ sequence.rig.T_imu_cam
    name = seen.frame * 10**6 + seen.track_id
    _, before, after = np.intersect1d(name + 10**6, name, return_indices=True)
    T_after_before = se3_inverse(T_world_cam[seen.frame[after]]) @ T_world_cam[seen.frame[before]]
    points = transform(T_after_before, triangulate(seen.uv_px[before], sequence.rig))
    residual_px = seen.uv_px[after] - project(points, sequence.rig)
    # 0.49 px; with the frames half a period early or late 0.63 and 0.83 px
    assert np.median(np.sqrt((residual_px**2).mean(axis=1))) < 0.55


def test_a_wheel_without_the_files_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise RuntimeError(name)

    monkeypatch.setattr(gtsam, "findExampleDataFile", absent)
    with pytest.raises(DataError, match=r"no example file VO_stereo_factors00; install gtsam>=4.3"):
        kitti00.make(0)
