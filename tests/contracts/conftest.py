"""Small valid files of every format, as bytes, for tests of what happens when they are not valid any more."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from tests.datasets.test_course_npy import course_dict
from tests.datasets.test_own_tables import written
from toolkit.datasets import vislam_recording
from toolkit.datasets.trajectories import FORMATS
from toolkit.estimate import Trajectory
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate

# A recording as its files: the content by the name in the folder; one file alone has the name "".
Files = dict[str, bytes]


@pytest.fixture(scope="session")
def original(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Files]:
    """Return a function that gives a small valid recording, or trajectory, of a format by its name."""
    made = valid_files(tmp_path_factory.mktemp("workshop")) | valid_trajectories()
    return lambda name: made[name]


def valid_files(workshop: Path) -> dict[str, Files]:
    """Return a small valid recording of every format, as its files."""
    few = {"max_tracks": 12}
    drive = simulate(replace(DRIVE, duration_s=1.5, camera=replace(DRIVE.camera, **few)), 0)
    flight = simulate(replace(FLIGHT, duration_s=0.5, camera=replace(FLIGHT.camera, **few)), 0)
    saved, now = {}, course_dict(drive, "inverted, camera axes optical", mismatched=0.0)
    for sequence in (drive, flight):
        vislam_recording.save(sequence, workshop / sequence.name)
        saved[f"vislam {sequence.name}"] = _contents(workshop / sequence.name)
    return {
        **saved,
        **_course(drive, now),
        "own tables": _contents(written(flight, workshop / "own")),
        "utias": _utias(drive, now),
        "openvins": openvins_files(flight),
        "lean euroc": _lean(flight),
    }


def _contents(folder: Path) -> Files:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def _course(sequence: Sequence, now: dict[str, Any]) -> dict[str, Files]:
    """Return a recording as the course writes it now and before."""
    before = {"time_stamps": now["timestamps"], "features": now["features"], "K": now["K_l"]}
    before |= {"linear_velocity": now["v_t"].T, "angular_velocity": now["w_t"].T}
    npz, npy = io.BytesIO(), io.BytesIO()
    np.savez(npz, **before, b=np.array(sequence.rig.baseline_m), imu_T_cam=now["extL_T_imu"])
    np.save(npy, np.array(now, dtype=object), allow_pickle=True)
    return {"course": {"": npz.getvalue()}, "course npy": {"": npy.getvalue()}}


def _utias(sequence: Sequence, now: dict[str, Any]) -> Files:
    rig, truth = sequence.rig, sequence.truth
    T_cam_imu = np.linalg.inv(rig.T_imu_cam)
    out = io.BytesIO()
    variables = {
        "y_k_j": np.moveaxis(now["features"], 1, 2),
        "t": now["timestamps"][None],
        "v_vk_vk_i": now["v_t"].T,
        "w_vk_vk_i": now["w_t"].T,
        "r_i_vk_i": truth.T_world_imu[:, :3, 3].T,
        "theta_vk_i": np.zeros((3, sequence.frame_count)),
        "C_c_v": T_cam_imu[:3, :3],
        "rho_v_c_v": rig.T_imu_cam[:3, 3:],
        **{"fu": rig.fx_px, "fv": rig.fy_px, "cu": rig.cx_px, "cv": rig.cy_px, "b": rig.baseline_m},
    }
    scipy.io.savemat(out, variables)
    return {"": out.getvalue()}


def openvins_files(sequence: Sequence) -> Files:
    """Return a simulation as an export of OpenVINS' simulator, by the names of its files."""
    rig, seen = sequence.rig, sequence.observations
    pinhole = {"fx": rig.fx_px, "fy": rig.fy_px, "cx": rig.cx_px, "cy": rig.cy_px, "k1": 0, "k2": 0, "p1": 0, "p2": 0}
    right = rig.T_imu_cam.copy()
    right[:3, 3] += rig.baseline_m * right[:3, 0]
    calibration = {
        "cam0": {**pinhole, "T_imu_cam": rig.T_imu_cam.tolist()},
        "cam1": {**pinhole, "T_imu_cam": right.tolist()},
        "imu": {key: float(np.min(value)) for key, value in vars(sequence.noise).items()},
        "pixel_noise_sigma": 1.0,
        "gravity_world": sequence.gravity_world.tolist(),
    }
    stamps = sequence.frames_t_ns / 1e9
    imu = [_row(t / 1e9, *values) for t, values in zip(sequence.motion.t_ns, sequence.motion.values, strict=True)]
    features = [
        _row(stamps[k], k, track, u_left, v, u_right, v, 1, 1)
        for k, track, (u_left, u_right, v) in zip(seen.frame, seen.track_id, seen.uv_px, strict=True)
    ]
    trajectory = _trajectory(sequence)
    return {
        "calib.json": json.dumps(calibration).encode(),
        "imu.csv": "\n".join(["timestamp,ax,ay,az,gx,gy,gz", *imu]).encode(),
        "features.csv": "\n".join(["timestamp,frame,feature_id,uL,vL,uR,vR,in_left,in_right", *features]).encode(),
        "est.txt": FORMATS["openvins"].text(trajectory).encode(),
    }


def _lean(sequence: Sequence) -> Files:
    names = ",".join(f"{n}_{a}" for n in ("w_RS_S", "a_RS_S") for a in "xyz")
    motion = sequence.motion
    gyro_first = motion.values[:, [3, 4, 5, 0, 1, 2]]
    imu = [f"{t},{_row(*values)}" for t, values in zip(motion.t_ns, gyro_first, strict=True)]
    return {
        "imu.csv": "\n".join([f"#timestamp [ns],{names}", *imu]).encode(),
        "cam_timestamps_ns.txt": "\n".join(map(str, sequence.frames_t_ns)).encode(),
        "truth.csv": FORMATS["euroc"].text(_trajectory(sequence)).encode(),
    }


def valid_trajectories() -> dict[str, Files]:
    """Return a small valid trajectory of every format."""
    trajectory = _trajectory(simulate(replace(FLIGHT, duration_s=0.5), 0))
    return {f"{name} file": {"": module.text(trajectory).encode()} for name, module in FORMATS.items()}


def _trajectory(sequence: Sequence) -> Trajectory:
    return Trajectory(sequence.truth.t_ns, sequence.truth.T_world_imu)


def _row(*values: float) -> str:
    return ",".join(f"{value:.15g}" for value in values)
