"""Small valid files of every format, as bytes, for tests of what happens when they are not valid any more."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from tests.datasets.test_own_tables import written
from toolkit.datasets import vislam_recording
from toolkit.datasets.trajectories import FORMATS
from toolkit.estimate import Trajectory
from toolkit.geometry import se3
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
    saved = {}
    for sequence in (drive, flight):
        vislam_recording.save(sequence, workshop / sequence.name)
        saved[f"vislam {sequence.name}"] = _contents(workshop / sequence.name)
    return {
        **saved,
        **_course(drive),
        "own tables": _contents(written(flight, workshop / "own")),
        "utias": _utias(drive),
        "openvins": openvins_files(flight),
        "lean euroc": _lean(flight),
    }


def _contents(folder: Path) -> Files:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def _course(sequence: Sequence) -> dict[str, Files]:
    """Return a recording as the course writes it now and before."""
    rig, stamps, count = sequence.rig, sequence.frames_t_ns / 1e9, sequence.frame_count
    v, w = np.split(sequence.motion.values[:count], 2, axis=1)
    T_imu_right = rig.T_imu_cam @ se3(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0]))
    K = np.array([[rig.fx_px, 0.0, rig.cx_px], [0.0, rig.fy_px, rig.cy_px], [0.0, 0.0, 1.0]])
    features, b, T_imu_cam = _corners(sequence), np.array(rig.baseline_m), rig.T_imu_cam
    before = {"time_stamps": stamps, "features": features, "linear_velocity": v.T, "angular_velocity": w.T}
    now = {"v_t": v, "w_t": w, "timestamps": stamps, "features": features, "K_l": K, "K_r": K}
    npz, npy = io.BytesIO(), io.BytesIO()
    np.savez(npz, **before, K=K, b=b, imu_T_cam=T_imu_cam)
    np.save(npy, np.array({**now, "extL_T_imu": T_imu_cam, "extR_T_imu": T_imu_right}, dtype=object), allow_pickle=True)
    return {"course": {"": npz.getvalue()}, "course npy": {"": npy.getvalue()}}


def _corners(sequence: Sequence) -> np.ndarray:
    """Return features (4, M, K) of uL, vL, uR, vR, -1 where a track is not seen."""
    seen = sequence.observations
    track = np.unique(seen.track_id, return_inverse=True)[1]
    features = np.full((4, track.max() + 1, sequence.frame_count), -1.0)
    features[:, track, seen.frame] = seen.uv_px[:, [0, 2, 1, 2]].T
    return features


def _utias(sequence: Sequence) -> Files:
    rig, count, truth = sequence.rig, sequence.frame_count, sequence.truth
    T_cam_imu = np.linalg.inv(rig.T_imu_cam)
    out = io.BytesIO()
    variables = {
        "y_k_j": np.moveaxis(_corners(sequence), 1, 2),
        "t": sequence.frames_t_ns[None] / 1e9,
        "v_vk_vk_i": sequence.motion.values[:count, :3].T,
        "w_vk_vk_i": sequence.motion.values[:count, 3:].T,
        "r_i_vk_i": truth.T_world_imu[:, :3, 3].T,
        "theta_vk_i": np.zeros((3, count)),
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
