"""The real KITTI 00 stretch of the gtsam wheel: size, conventions and noise."""

import gtsam
import numpy as np
import pytest

from toolkit.datasets import kitti00, load_sequence
from toolkit.errors import DataError
from toolkit.measurements import ImuNoise
from toolkit.models.noise import white_sigma
from toolkit.sequence import Sequence


@pytest.fixture(scope="module")
def sequence() -> Sequence:
    return load_sequence("kitti00")


def test_the_imu_is_one_sample_longer_than_frames_14_to_153_with_gravity_up(sequence: Sequence) -> None:
    assert sequence.duration_s == pytest.approx(139 * 0.10366, abs=1e-6)
    assert sequence.truth is None
    t_ns, motion = sequence.frames_t_ns, sequence.motion
    assert ((motion.t_ns >= t_ns[0]) & (motion.t_ns <= t_ns[-1])).sum() == motion.t_ns.size - 2
    np.testing.assert_allclose(motion.values[:, :3].mean(axis=0), [0.0, 0.0, 9.8], atol=0.5)


def test_the_stated_noise_covers_the_scatter_of_the_samples_only_as_densities(sequence: Sequence) -> None:
    assert isinstance(sequence.noise, ImuNoise)
    root_dt = 0.1  # 100 Hz
    scatter = white_sigma(sequence.motion.values) * root_dt
    assert scatter[:3].max() < sequence.noise.accel_noise_density
    assert scatter[3:].max() < sequence.noise.gyro_noise_density
    assert scatter[:3].min() > sequence.noise.accel_noise_density * root_dt
    assert scatter[3:].min() > sequence.noise.gyro_noise_density * root_dt


def test_a_wheel_without_the_files_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise RuntimeError(name)

    monkeypatch.setattr(gtsam, "findExampleDataFile", absent)
    with pytest.raises(DataError, match=r"no example file VO_stereo_factors00; install gtsam>=4.3"):
        kitti00.make(0)
