"""Other draws of a recording's noise: its own motion, landmarks and sightings, measured anew; not part of the tests.

    python tests/benchmarks/redrawn_noise.py ../shared/data/openvins_sim/udel_gore_rect_s0 --lengths 1.2 2.0 --seeds 4

For a simulated export with raw IMU samples and exact truth. A quintic spline through the poses at the frames is the
motion, exact by definition; each landmark is where all sightings of its track put it; pixels, IMU samples and biases
are drawn with the noise that the recording states. So an estimator is evaluated on draws that nobody has chosen it by.

A line a length of the window, all of it the mean over draws of what changes against the first length, in log: the
deviation of heading that the filter states at the end and that of its position, which differ little between draws, and
the errors that it made, ATE yaw and that of the motion over five seconds, which differ much. Beside them the squared
error of the heading over its stated variance, the mean over frames and draws: 1 if what is stated is true.
"""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from toolkit.estimate import Trajectory
from toolkit.experiment.recording import Recording, prepare
from toolkit.geometry import Array, se3_inverse, se3_log, so3_exp, so3_log, transform
from toolkit.initialization import start_from_measurements
from toolkit.measurements import NS_PER_S, ImuNoise
from toolkit.metrics.parts.against_truth import fit_yaw
from toolkit.models import stereo
from toolkit.registry import find
from toolkit.runner import run
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.settings import Settings, Window
from toolkit.simulation.sensors import Imu, ImuStamps, measure_imu
from toolkit.simulation.trajectory import FreeTrajectory, RotationSpline, UniformKnots, VectorSpline, blending_matrix

IMU_HZ, START_BIAS_SIGMA = 400.0, np.repeat([1e-3, 1e-4], 3)
MARGIN, FITTING_STEPS, RELATIVE_FRAMES, FIRST_CHECKED = 6, 60, 50, 100
NAMES = ("stated heading", "stated position", "ATE yaw", "over 5 s", "NEES heading", "CPU ms")


class World(NamedTuple):
    """The recording, its motion as a spline, and the exact images (N, 3) px of its sightings."""

    recording: Sequence
    motion: FreeTrajectory
    uv_px: Array


def world_of(sequence: Sequence) -> World:
    """Return the world of a recording with a truth at its frames."""
    assert sequence.truth is not None
    rows = np.searchsorted(sequence.truth.t_ns, sequence.frames_t_ns - NS_PER_S // 10**6)
    poses = sequence.truth.T_world_imu[rows]
    motion = spline_through(frame_times_s(sequence), poses)
    points, track = landmarks(sequence, poses)
    seen_from = motion.at(frame_times_s(sequence)).T_world_imu[sequence.observations.frame]
    return World(sequence, motion, images(points[track], seen_from, sequence))


def frame_times_s(sequence: Sequence) -> Array:
    """Return the stamps (K,) s since the first frame."""
    return (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S


def images(points: Array, poses: Array, sequence: Sequence) -> Array:
    """Return what poses (N, 4, 4) see of points (N, 3), (N, 3) px."""
    T_cam_world = se3_inverse(poses @ sequence.rig.T_imu_cam)
    return stereo.project(transform(T_cam_world, points), sequence.rig)


def spline_through(t_s: Array, poses: Array) -> FreeTrajectory:
    """Return a spline through poses (K, 4, 4); its rotations are fitted step by step, to a microradian."""
    step_s = float(np.median(np.diff(t_s)))
    knots = UniformKnots(t_s[0] - MARGIN * step_s, step_s)
    count = len(t_s) + 2 * MARGIN
    first, phase = knots.locate(t_s, count)
    weights = knots.powers(phase, 0) @ blending_matrix(knots.order).T
    columns = first[:, None] + np.arange(knots.order)
    rows = np.repeat(np.arange(len(t_s)), knots.order)
    at = csr_array((weights.ravel(), (rows, columns.ravel())), shape=(len(t_s), count))
    smooth = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    control = spsolve((at.T @ at + 1e-6 * smooth.T @ smooth).tocsc(), at.T @ poses[:, :3, 3])
    nearest = np.clip(np.arange(count) - MARGIN, 0, len(t_s) - 1)
    turned = poses[nearest, :3, :3]
    for _ in range(FITTING_STEPS):
        rotation, _ = RotationSpline(knots, turned).at(t_s)
        turned = turned @ so3_exp(so3_log(np.swapaxes(rotation, 1, 2) @ poses[:, :3, :3])[nearest])
    return FreeTrajectory(VectorSpline(knots, control), RotationSpline(knots, turned))


def landmarks(sequence: Sequence, poses: Array) -> tuple[Array, Array]:
    """Return the points (T, 3) that fit all sightings of each track best, and the track (N,) of each sighting."""
    seen, rig = sequence.observations, sequence.rig
    _, track = np.unique(seen.track_id, return_inverse=True)
    from_poses = poses[seen.frame]
    T_cam_world = se3_inverse(from_poses @ rig.T_imu_cam)
    weight = np.maximum(stereo.disparity_px(seen.uv_px), 0.1) ** 4
    alone = stereo.triangulate_world(seen.uv_px, from_poses, rig)
    points = np.stack([np.bincount(track, weight * p) for p in alone.T], axis=1) / np.bincount(track, weight)[:, None]
    for _ in range(8):
        H = stereo.projection_jacobian(transform(T_cam_world, points[track]), rig) @ T_cam_world[:, :3, :3]
        H, residual = rig.whitener @ H, (seen.uv_px - images(points[track], from_poses, sequence)) @ rig.whitener.T
        normal, right = np.tile(1e-9 * np.eye(3), (len(points), 1, 1)), np.zeros((len(points), 3, 1))
        np.add.at(normal, track, np.swapaxes(H, 1, 2) @ H)
        np.add.at(right, track, np.swapaxes(H, 1, 2) @ residual[..., None])
        points = points + np.linalg.solve(normal, right)[..., 0]
    return points, track


def redrawn(world: World, seed: int) -> Sequence:
    """Return the recording with other noise and no prior."""
    recording, seen = world.recording, world.recording.observations
    assert isinstance(recording.noise, ImuNoise)
    pixels_rng, motion_rng = np.random.default_rng([seed, 77]).spawn(2)
    spread = np.linalg.cholesky(recording.rig.cov_uv_px2)
    uv_px = world.uv_px + pixels_rng.standard_normal(world.uv_px.shape) @ spread.T
    t_s, start_ns = frame_times_s(recording), int(recording.frames_t_ns[0])
    stamps = ImuStamps.over(start_ns, IMU_HZ, float(t_s[-1]) + 0.02)
    imu = Imu(IMU_HZ, recording.noise, START_BIAS_SIGMA)
    measured = measure_imu(imu, 1.0, stamps, world.motion, recording.gravity_world, motion_rng)
    exact = world.motion.at(t_s)
    return Sequence(
        name=recording.name,
        rig=recording.rig,
        noise=recording.noise,
        frames_t_ns=recording.frames_t_ns,
        observations=Observations(seen.frame, seen.track_id, uv_px),
        motion=measured.samples,
        provenance=recording.provenance,
        truth=Truth(recording.frames_t_ns, exact.T_world_imu, exact.v_world),
        gravity_world=recording.gravity_world,
    )


def figures(sequence: Sequence, reported: Trajectory, cpu_s: float) -> Array:
    """Return the figures that NAMES has, logarithms but for the last two."""
    assert sequence.truth is not None and reported.cov is not None
    truth, own, count = sequence.truth.T_world_imu[: len(reported.t_ns)], reported.T_world_imu, len(reported.t_ns)
    attitude = own[:, :3, :3]
    heading_var = (attitude @ reported.cov[:, :3, :3] @ np.swapaxes(attitude, 1, 2))[:, 2, 2]
    turned = attitude @ np.swapaxes(truth[:, :3, :3], 1, 2)
    heading = np.unwrap(np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1]))
    nees = ((heading - heading[0]) ** 2 / heading_var)[FIRST_CHECKED::RELATIVE_FRAMES].mean()
    position_var = np.trace(reported.cov[FIRST_CHECKED:, 3:6, 3:6], axis1=1, axis2=2).mean()
    off = fit_yaw(truth[:, :3, 3], own[:, :3, 3]).apply(own)[:, :3, 3] - truth[:, :3, 3]
    k = np.arange(FIRST_CHECKED, count - RELATIVE_FRAMES, 10)
    moved, claimed = (se3_inverse(T[k]) @ T[k + RELATIVE_FRAMES] for T in (truth, own))
    over_5_s = (se3_log(se3_inverse(moved) @ claimed)[:, 3:] ** 2).sum(axis=1).mean()
    logs = 0.5 * np.log([heading_var[-1], position_var, (off**2).sum(axis=1).mean(), over_5_s])
    return np.array([*logs, nees, 1e3 * cpu_s / count])


def main() -> None:
    """Print a line a draw and length as it ends, and the table at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--estimator", default="msckf-fej")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--lengths", type=float, nargs="+", default=[1.2, 1.5, 2.0])
    wanted = parser.parse_args()
    world, build = world_of(prepare(Recording(str(wanted.source))).sequence), find(wanted.estimator).load()
    found = np.zeros((wanted.seeds, len(wanted.lengths), len(NAMES)))
    for seed in range(wanted.seeds):
        sequence = redrawn(world, seed).truncated(wanted.frames)
        prior = start_from_measurements(sequence)
        for i, lag_s in enumerate(wanted.lengths):
            settings = Settings(window=Window(lag_s=lag_s, most_states=100))
            began = time.process_time()
            causal = run(wanted.estimator, build, sequence, prior, settings=settings).causal
            assert causal is not None
            found[seed, i] = figures(sequence, causal, time.process_time() - began)
            print(seed, lag_s, found[seed, i].round(3), flush=True)
    change = found - np.where(np.arange(len(NAMES)) < 4, found[:, :1], 0.0)
    mean, error = change.mean(axis=0), change.std(axis=0, ddof=1) / np.sqrt(wanted.seeds)
    for i, lag_s in enumerate(wanted.lengths):
        cells = [f"{n} {m:+.3f} ± {e:.3f}" for n, m, e in zip(NAMES, mean[i], error[i], strict=True)]
        print(f"{lag_s:4g} s  " + "  ".join(cells))


if __name__ == "__main__":
    main()
