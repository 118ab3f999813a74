"""The UTIAS Matlab files: conventions proved by reprojection under their truth, and malformed ones."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from toolkit.datasets import load_sequence, utias_mat
from toolkit.geometry import se3_inverse, transform
from toolkit.measurements import NS_PER_S, TwistNoise
from toolkit.models.stereo import project, triangulate
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence

DRIVES = [
    ("2011_09_26_drive_0001_sync_KLT", 108, 707, 10501),
    ("2011_09_26_drive_0005_sync_KLT", 154, 911, 13908),
    ("2011_09_26_drive_0009_sync_KLT", 446, 1461, 26708),
    ("2011_09_26_drive_0027_sync_KLT", 188, 1281, 12660),
    ("2011_09_26_drive_0035_sync_KLT", 131, 536, 11588),
    ("2011_09_26_drive_0051_sync_KLT", 125, 741, 7984),
    ("2011_09_30_drive_0027_sync_KLT", 500, 2811, 44556),
    ("dataset3", 1900, 20, 9410),
]


def one_step_median_px(sequence: Sequence) -> float:
    """Return the median root mean square of (uL, uR, v) when a sighting is carried to the next frame by the truth."""
    assert sequence.truth is not None
    seen, T_world_cam = sequence.observations, sequence.truth.T_world_imu @ sequence.rig.T_imu_cam
    name = seen.frame * 10**6 + seen.track_id
    _, before, after = np.intersect1d(name + 10**6, name, return_indices=True)
    usable = seen.uv_px[before, 0] - seen.uv_px[before, 1] > 2.0
    before, after = before[usable], after[usable]
    T_after_before = se3_inverse(T_world_cam[seen.frame[after]]) @ T_world_cam[seen.frame[before]]
    points = transform(T_after_before, triangulate(seen.uv_px[before], sequence.rig))
    residual_px = seen.uv_px[after] - project(points, sequence.rig)
    return float(np.median(np.sqrt((residual_px**2).mean(axis=1))))


def written(folder: Path, variables: dict[str, Any]) -> Path:
    path = folder / "small.mat"
    scipy.io.savemat(path, variables)
    return path


@pytest.mark.parametrize(("name", "frames", "tracks", "observations"), DRIVES)
def test_real_recordings_have_their_known_size_and_fit_their_truth(
    real: Callable[[str], Path], name: str, frames: int, tracks: int, observations: int
) -> None:
    sequence = load_sequence(str(real(f"utias/{name}.mat")))
    assert sequence.frame_count == sequence.motion.t_ns.size == frames
    assert np.unique(sequence.observations.track_id).size == tracks
    assert len(sequence.observations) == observations
    # 0.33-0.77 px on the drives and 1.87 px indoors; a transposed rotation gives 1.2-17 px and 7.6 px
    assert one_step_median_px(sequence) < (2.0 if name == "dataset3" else 0.8)


def test_indoor_twist_errors_have_the_stated_variances_under_the_stated_pairing(real: Callable[[str], Path]) -> None:
    path = real("utias/dataset3.mat")
    sequence = utias_mat.load(path)
    assert sequence.truth is not None
    assert isinstance(sequence.motion, TwistSamples)
    assert sequence.motion.pairing == "start"
    R_world_imu = sequence.truth.T_world_imu[:, :3, :3]
    dt_s = np.diff(sequence.truth.t_ns) / NS_PER_S
    moved = np.diff(sequence.truth.T_world_imu[:, :3, 3], axis=0) / dt_s[:, None]
    error_mps = np.einsum("nji,nj->ni", R_world_imu[:-1], moved) - sequence.motion.v_mps[:-1]
    # chords against arcs account for the rest
    np.testing.assert_allclose((error_mps**2).mean(axis=0), scipy.io.loadmat(path)["v_var"][:, 0], rtol=0.05)


def test_measured_variances_become_densities_over_the_median_step(utias: dict[str, Any], tmp_path: Path) -> None:
    variances = {key: np.full((3, 1), 0.04) for key in ("v_var", "w_var")} | {"y_var": np.arange(1.0, 5.0)[:, None]}
    sequence = utias_mat.load(written(tmp_path, utias | variances))
    assert isinstance(sequence.noise, TwistNoise)
    # stamps near 1.3e9 s are doubles good to 0.24 microseconds, 2.4e-6 of a step
    np.testing.assert_allclose(sequence.noise.velocity_noise_density, 0.2 * np.sqrt(0.1), rtol=3e-6)
    np.testing.assert_array_equal(sequence.rig.cov_uv_px2, np.diag([1.0, 3.0, 3.0]))
