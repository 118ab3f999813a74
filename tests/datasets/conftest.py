"""Recordings small enough to write, spoil and read again in a test, and the way to the real ones."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text in a file, the first time it stands there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.fixture
def course() -> dict[str, Any]:
    """Return the arrays of a course recording: 5 frames, 3 tracks, and one sighting without its uR."""
    features = np.full((4, 3, 5), -1.0)
    features[:, 0, :3] = np.array([400.0, 200.0, 380.0, 202.0])[:, None]
    features[:, 2, 1:] = np.array([100.0, 50.0, 90.0, 50.0])[:, None] + np.arange(4)
    features[2, 2, 4] = -1.0
    return {
        "time_stamps": 1.3e9 + 0.1 * np.arange(5)[None],
        "features": features,
        "linear_velocity": np.ones((3, 5)),
        "angular_velocity": np.zeros((3, 5)),
        "K": np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]),
        "b": np.array(0.5),
        "imu_T_cam": np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 0, 1]]),
    }


@pytest.fixture
def utias() -> dict[str, Any]:
    """Return the variables of a UTIAS recording: 4 frames, 3 features, and twists that go on for 2 more frames."""
    features = np.full((4, 4, 3), -1.0)
    features[:, :, 1] = np.array([400.0, 200.0, 380.0, 202.0])[:, None]
    return {
        "y_k_j": features,
        "t": 1.3e9 + 0.1 * np.arange(4)[None],
        **{key: np.ones((3, 6)) for key in ("v_vk_vk_i", "r_i_vk_i")},
        **{key: np.zeros((3, 6)) for key in ("w_vk_vk_i", "theta_vk_i")},
        "C_c_v": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        "rho_v_c_v": np.array([[1.0], [0.2], [0.3]]),
        **{"fu": 500.0, "fv": 510.0, "cu": 320.0, "cv": 240.0, "b": 0.5},
    }


@pytest.fixture
def openvins(tmp_path: Path) -> Path:
    """Return the folder of an export of 4 frames, of which the first lies before the IMU and the last after it."""
    folder = tmp_path / "export"
    folder.mkdir()
    pinhole = {"fx": 458.0, "fy": 457.0, "cx": 367.0, "cy": 248.0, "k1": 0, "k2": 0, "p1": 0, "p2": 0}
    shifted = np.eye(4)
    shifted[0, 3] = 0.11
    densities = ("gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk")
    calibration = {
        "cam0": {**pinhole, "T_imu_cam": np.eye(4).tolist()},
        "cam1": {**pinhole, "T_imu_cam": shifted.tolist()},
        "imu": dict.fromkeys(densities, 0.001),
        "pixel_noise_sigma": 2,
        "gravity_world": [0, 0, -9.8],
    }
    (folder / "calib.json").write_text(json.dumps(calibration))
    imu = [f"{0.15 + 0.01 * k:.3f},0.1,0.2,0.3,1,2,9.8" for k in range(20)]
    (folder / "imu.csv").write_text("\n".join(["timestamp,gx,gy,gz,ax,ay,az", *imu]) + "\n")
    rows = [f"{0.1 * k + 0.1:.1f},{k},{7 - i},300,200,290,204,1,{i}" for k in range(4) for i in (0, 1)]
    columns = "timestamp,frame,feature_id,uL,vL,uR,vR,in_left,in_right"
    (folder / "features.csv").write_text("\n".join([columns, *rows]) + "\n")
    columns = "timestamp,frame,qw,qx,qy,qz,px,py,pz,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz"
    truth = [f"{0.1 * k + 0.1:.1f},{k},1,0,0,0,1,2,3,4,5,6,.1,.2,.3,.4,.5,.6" for k in range(4)]
    (folder / "truth_cam.csv").write_text("\n".join([columns, *truth]) + "\n")
    return folder


def assert_refused(read: Callable[[], object], path: Path, pattern: str) -> None:
    with pytest.raises(DataError, match=pattern) as raised:
        read()
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
