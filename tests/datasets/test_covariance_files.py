"""Covariances in trajectory files: conventions differ by exact derivatives, and what is written is read back."""

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.trajectories import euroc, openvins, read_poses, tum
from toolkit.datasets.trajectories.covariances import CONVENTIONS, OURS, StatedCovariances, to_right, written_as
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, se3, se3_exp, se3_inverse, se3_log, so3_exp
from toolkit.models.gating import mahalanobis_squared

COUNT = 7
FORMATS = {"tum": tum, "euroc": euroc, "openvins": openvins}
# NEES of what was written and read: 15 digits of covariances whose standard deviations differ a hundredfold.
TOLERANCE = 1e-9


def trajectory(size: int, seed: int = 1) -> Trajectory:
    """Poses far from the origin, turned any way, with correlated covariances of 1 mrad, 0.1 m and the like."""
    rng = np.random.default_rng(seed)
    poses = se3(so3_exp(2.0 * rng.normal(size=(COUNT, 3))), 100.0 * rng.normal(size=(COUNT, 3)))
    mixing = np.eye(size) + 0.3 * rng.normal(size=(COUNT, size, size)) / np.sqrt(size)
    root = mixing * np.repeat([1e-3, 0.1, 0.05, 0.02, 1e-3], 3)[:size, None]
    motion = rng.normal(size=(2, COUNT, 6))
    t_ns = 10**18 + 10**8 * np.arange(COUNT)
    return Trajectory(t_ns, poses, motion[0, :, :3], motion[1], root @ np.swapaxes(root, 1, 2))


def perturbed(kind: str, T: Array, error: Array) -> Array:
    turn, shift = so3_exp(error[:3]), error[3:]
    if kind == "right":
        return T @ se3_exp(error)
    if kind == "left":
        return se3_exp(error) @ T
    turned = turn @ T[:3, :3] if kind == "fixed" else T[:3, :3] @ turn
    return se3(turned, T[:3, 3] + shift)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_derivatives_of_every_convention_are_the_numerical_ones(name: str) -> None:
    """Central differences with a step of 1e-4: off by its square times the third derivative, and by rounding."""
    kind = CONVENTIONS[name].perturbation
    poses = trajectory(6).T_world_imu
    for T, exact in zip(poses, to_right(kind, poses), strict=True):
        steps = 1e-4 * np.eye(6)
        ends = [[se3_log(se3_inverse(T) @ perturbed(kind, T, sign * step)) for sign in (1, -1)] for step in steps]
        numerical = np.array([(plus - minus) / 2e-4 for plus, minus in ends]).T
        np.testing.assert_allclose(numerical, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("size", [6, 9, 12, 15])
def test_what_is_written_and_read_gives_the_same_nees(tmp_path: Path, name: str, size: int) -> None:
    given = trajectory(size)
    path = tmp_path / "poses.txt"
    path.write_text(FORMATS[name].text_with_covariances(given))
    read = read_poses(path)
    cov = read.covariances.of(read.T_world_imu)
    assert cov.shape[-1] == (size if name == "openvins" else 6)
    errors = np.random.default_rng(2).normal(size=(COUNT, cov.shape[-1]))
    before = mahalanobis_squared(errors, given.cov[:, : cov.shape[-1], : cov.shape[-1]])
    np.testing.assert_allclose(mahalanobis_squared(errors, cov), before, rtol=TOLERANCE)
    if name == "openvins":
        np.testing.assert_allclose(read.v_world, given.v_world, rtol=1e-14)
        np.testing.assert_allclose(read.bias, given.bias, rtol=1e-14)


@pytest.mark.parametrize("name", ["tum", "euroc"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_file_says_its_convention_and_is_read_by_it(tmp_path: Path, name: str, convention: str) -> None:
    given, path = trajectory(6), tmp_path / "poses.txt"
    path.write_text(FORMATS[name].text_with_covariances(given, CONVENTIONS[convention]))
    read = read_poses(path, OURS)
    assert read.covariances.convention == CONVENTIONS[convention]
    # Of left perturbations 100 m from the origin digits are lost: a turn of 1 mrad moves the pose by the stated 0.1 m.
    scale = np.sqrt(np.einsum("ni,nj->nij", *[np.einsum("nii->ni", given.cov)] * 2))
    assert (np.abs(read.covariances.of(read.T_world_imu) - given.cov) / scale).max() < 1e-9


def test_where_a_file_does_not_say_the_convention_the_user_does(tmp_path: Path) -> None:
    given, path = trajectory(6), tmp_path / "poses.txt"
    ros = CONVENTIONS["pos-rot/fixed"]
    text = tum.text_with_covariances(given, ros)
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith("#")))
    read = read_poses(path)
    assert read.covariances.convention is None
    assert read.covariances.of(read.T_world_imu) is None
    np.testing.assert_allclose(read.T_world_imu, given.T_world_imu, atol=1e-9)
    by_user = read_poses(path, ros)
    np.testing.assert_allclose(by_user.covariances.of(by_user.T_world_imu), given.cov, rtol=1e-9, atol=1e-15)


def test_a_convention_that_there_is_not_is_named_with_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(tum.text_with_covariances(trajectory(6)).replace("rot-pos/right", "rot-pos/rigth"))
    with pytest.raises(DataError, match=r"poses.txt: its header: no .* rot-pos/rigth \(did you mean rot-pos/right\?\)"):
        read_poses(path)


def test_the_lower_triangle_of_a_square_file_is_read_as_its_header_says(tmp_path: Path) -> None:
    given, path = trajectory(6), tmp_path / "est.SQUARE"
    first = written_as(CONVENTIONS["pos-rot/right"], given.T_world_imu, given.cov, 6)
    rows, columns = np.tril_indices(6)
    poses = [line for line in tum.text(given).splitlines() if not line.startswith("#")]
    entries = [" ".join(f"{value:.17g}" for value in cov[rows, columns]) for cov in first]
    header = "#%FORMAT SQUARE/0.3\n#%TANGENT_CONVENTION right_perturbation\n#%TANGENT_ORDER translation_rotation\n"
    path.write_text(header + "".join(f"{pose} {cov}\n" for pose, cov in zip(poses, entries, strict=True)))
    read = read_poses(path)
    np.testing.assert_allclose(read.covariances.of(read.T_world_imu), given.cov, rtol=1e-12, atol=1e-18)


def test_what_is_not_stated_stays_unknown_in_every_convention() -> None:
    """OpenVINS records orientation and position apart: what couples them is NaN, and nothing else, but where a turn
    moves the position.
    """
    given = trajectory(6)
    values = given.cov.copy()
    values[:, :3, 3:] = values[:, 3:, :3] = np.nan
    for one, other in permutations(("right", "fixed", "mixed"), 2):
        moved = StatedCovariances(values, None).read_as(CONVENTIONS[f"rot-pos/{one}"], given.T_world_imu)
        back = written_as(CONVENTIONS[f"rot-pos/{other}"], given.T_world_imu, moved, 6)
        assert np.isnan(back[:, :3, 3:]).all()
        assert np.isfinite(back[:, :3, :3]).all()
        assert np.isfinite(back[:, 3:, 3:]).all()
    left = StatedCovariances(values, None).read_as(CONVENTIONS["rot-pos/left"], given.T_world_imu)
    assert np.isfinite(left[:, :3, :3]).all()
    assert np.isnan(left[:, 3:, 3:]).all()
