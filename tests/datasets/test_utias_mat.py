"""The UTIAS Matlab files: conventions proved by reprojection under their truth, and malformed ones."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from toolkit.datasets import utias_mat
from toolkit.measurements import NS_PER_S, TwistNoise
from toolkit.motion_samples import TwistSamples


def written(folder: Path, variables: dict[str, Any]) -> Path:
    path = folder / "small.mat"
    scipy.io.savemat(path, variables)
    return path


def test_indoor_twist_errors_have_the_stated_variances_under_the_stated_pairing(real: Callable[[str], Path]) -> None:
    path = real("utias/dataset3.mat")
    sequence = utias_mat.load(path)
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
