"""Small exact recordings for the metrics: a path with known poses, points seen from it, and runs made from both."""

from dataclasses import replace

import numpy as np

from toolkit.answers import Run, Timings
from toolkit.estimate import Landmarks, Trajectory
from toolkit.geometry import Array, about_z, se3, se3_exp, se3_inverse, so3_exp, transform
from toolkit.measurements import ImuNoise, StereoRig, TwistNoise
from toolkit.models import stereo
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth

PERIOD_NS = 100_000_000
# Camera axes (right, down, forward) in IMU axes (forward, left, up), a little above and ahead of it.
T_IMU_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.8, 0.1, 0.3]))
# Unequal variances, so that forgetting to whiten shows.
RIG = StereoRig(700.0, 710.0, 620.0, 190.0, 0.54, T_IMU_CAM, np.diag([1.0, 1.0, 0.5]))


def drive_poses(count: int, step_m: float = 1.0) -> Array:
    """Return poses (count, 4, 4) of a car on a winding, hilly road, ``step_m`` apart, starting off the origin."""
    s = step_m * np.arange(count)
    heading = 0.4 * np.sin(s / 60.0) + 0.3
    steps = step_m * np.stack([np.cos(heading), np.sin(heading), 0.05 * np.cos(s / 25.0)], axis=1)
    positions = np.array([5.0, -3.0, 1.0]) + np.cumsum(steps, axis=0)
    pitch_roll = so3_exp(np.stack([0.02 * np.sin(s / 9.0), -0.05 * np.cos(s / 25.0), 0.0 * s], axis=1))
    return se3(about_z(heading) @ pitch_roll, positions)


def sightings(
    poses: Array, track_count: int, pixel_sigma: float, rng: np.random.Generator
) -> tuple[Observations, Array]:
    """Return stereo sightings of points beside the road, in front of at most ~20 frames each, and the points."""
    seen_last = rng.integers(4, len(poses), track_count)
    ahead = np.stack(
        [rng.uniform(4.0, 9.0, track_count), rng.uniform(-4, 4, track_count), rng.uniform(-1, 2, track_count)]
    )
    points = transform(poses[seen_last] @ T_IMU_CAM, ahead[[1, 2, 0]].T)
    first = np.maximum(seen_last - rng.integers(1, 20, track_count), 0)
    rows = [(k, i) for i in range(track_count) for k in range(first[i], seen_last[i] + 1)]
    frame, track = np.array(rows).T
    uv_px = stereo.project(transform(se3_inverse(poses @ T_IMU_CAM)[frame], points[track]), RIG)
    uv_px = uv_px + pixel_sigma * rng.standard_normal(uv_px.shape)
    return Observations.sorted(frame, track, uv_px), points


def make_sequence(poses: Array, track_count: int = 300, pixel_sigma: float = 0.0, motion: str = "twist") -> Sequence:
    t_ns = 1_317_386_425_562_502_384 + PERIOD_NS * np.arange(len(poses))
    observations, _ = sightings(poses, track_count, pixel_sigma, np.random.default_rng(5))
    zeros, three = np.zeros((len(poses), 3)), np.full(3, 0.1)
    imu = motion == "imu"
    return Sequence(
        name="synthetic",
        rig=RIG,
        noise=ImuNoise(1e-3, 1e-4, 1e-4, 1e-5) if imu else TwistNoise(three, three, three),
        frames_t_ns=t_ns,
        observations=observations,
        motion=ImuSamples(t_ns, zeros, zeros) if imu else TwistSamples(t_ns, zeros, zeros),
        provenance=Provenance("test", "tests/metrics/conftest.py"),
        truth=Truth(t_ns, poses),
    )


def make_run(t_ns: Array, poses: Array, landmarks: Landmarks | None = None, **changes: object) -> Run:
    trajectory = Trajectory(t_ns, poses)
    timings = Timings(np.array([0.004, 0.001, 0.001, 0.002]), 0.5, 0.6, 0.7, 123.0)
    run = Run("test", "ok", trajectory, trajectory, landmarks or Landmarks.none(), timings)
    return replace(run, **changes)


def perturb(poses: Array, sigma: float, seed: int) -> Array:
    steps = np.random.default_rng(seed).normal(0.0, sigma, (len(poses), 6))
    return poses @ se3_exp(np.cumsum(steps, axis=0) * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0]))
