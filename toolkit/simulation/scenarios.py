"""The simulated recordings: `drive` (a car, twist or IMU) and `flight` (hand-held or aerial, IMU).

Both also exist as `-realistic`, with tracks whose errors are correlated like those of real trackers (docs/tracks.md).

Trajectory and landmarks belong to the scenario; the seed draws the prior's error, the biases, all noise, the random
ends of tracks and the outliers. Each has a stream of its own, which differs between scenarios: two scenarios under one
seed are independent draws. Repeating a scenario over seeds is therefore a Monte-Carlo experiment about noise, as a
consistency test needs (Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 5.4). Where the world varies, the seed draws trajectory and landmarks too.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple
from zlib import crc32

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, nearest_rotation, se3, so3_exp
from toolkit.measurements import GRAVITY_WORLD, NS_PER_S, ImuNoise, Prior, StereoRig, TwistNoise
from toolkit.motion_samples import MotionSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth
from toolkit.settings import SettingsError
from toolkit.simulation import sensors
from toolkit.simulation.scenes import Kinematics, Scene, SceneOf, SmoothTrajectory, hall, road
from toolkit.simulation.sensors import CameraLimits, Imu, Odometer, TrackNoise

START_NS = 1_600_000_000 * NS_PER_S
# The measurements of an hour take a gigabyte.
LONGEST_S = 3600.0
# Standard deviations of the prior: rotation (rad), position (m), velocity (m/s), all in the body frame.
_PRIOR_SIGMA = np.repeat([0.002, 0.01, 0.05], 3)
# Estimators of twists have no accelerometer bias, but its block of the prior must be positive definite.
_UNUSED_ACCEL_BIAS_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class Scenario:
    """Everything about a simulated recording except its seed.

    ``scene`` builds the trajectory and the world for a duration; ``varied`` lets every seed draw its own.
    ``noise_scale`` multiplies every drawn error (pixels, motion, biases, prior) and leaves the stated noise as it is,
    so that 0 gives exact measurements with a noise for estimators to assume. ``has_surfaces`` says that its world has
    surfaces besides landmarks and can be filmed (:mod:`~toolkit.simulation.filming`). With a ``track_noise``, the
    errors of tracks are drawn from it instead of the rig's covariance, which then is what a data sheet would state; a
    ``slip_share`` of the tracks slips to another point and stays there. An audit of the first ``audited_s`` seconds,
    where that is known, decides every fault as an audit of the whole recording does.
    """

    name: str
    scene: SceneOf
    rig: StereoRig
    camera: CameraLimits
    motion: Odometer | Imu
    duration_s: float = 60.0
    noise_scale: float = 1.0
    varied: bool = False
    track_noise: TrackNoise | None = None
    slip_share: float = 0.0
    gravity_world: Array = field(default_factory=lambda: np.array(GRAVITY_WORLD))
    has_surfaces: bool = False
    audited_s: float | None = None


def noise_free(scenario: Scenario) -> Scenario:
    """Return the scenario with exact measurements, an exact prior and, where there is an IMU, a rate of 1 kHz.

    Exact IMU samples are instantaneous, so their integral is exact only in the limit: the error of the midpoint rule is
    proportional to the square of the sample interval.
    """
    camera = replace(scenario.camera, step_px=0.0, outlier_rate=0.0)
    exact = replace(scenario, noise_scale=0.0, slip_share=0.0, camera=camera)
    return replace(exact, motion=replace(exact.motion, rate_hz=1000.0)) if isinstance(exact.motion, Imu) else exact


def simulate(scenario: Scenario, seed: int) -> Sequence:
    """Return the recording of a scenario under one seed; equal arguments give bit-identical recordings.

    Raises SettingsError for a duration that gives no two frames, or more than an hour.
    """
    if not 1.0 / scenario.camera.rate_hz <= scenario.duration_s <= LONGEST_S:
        raise SettingsError(
            f"a simulation of {scenario.duration_s:g} s is not possible; its duration is from "
            f"{1.0 / scenario.camera.rate_hz:g} to {LONGEST_S:g} s"
        )
    # The number by which a name enters the seeds is 0 for drive, whose draws depend on the seed alone.
    number = crc32(scenario.name.encode()) ^ crc32(b"drive")
    streams = np.random.SeedSequence((seed, number)).spawn(7)
    prior_rng, motion_rng, *track_rngs, world_rng, slips_rng = map(np.random.default_rng, streams)
    parts = scenario.scene, scenario.duration_s, scenario.rig, scenario.camera
    view = _view(*parts, world_rng) if scenario.varied else _view_of_all_seeds(*parts)
    frames_t_ns, motion = view.frames_t_ns, view.motion
    samples, bias = _measure_motion(scenario, view.scene.trajectory, frames_t_ns, motion_rng)
    last_sample = np.searchsorted(samples.t_ns, frames_t_ns, side="right") - 1
    return Sequence(
        name=scenario.name,
        rig=scenario.rig,
        noise=scenario.motion.noise,
        frames_t_ns=frames_t_ns,
        observations=_observe(scenario, view, [*track_rngs, slips_rng]),
        motion=samples,
        provenance=_provenance(scenario, seed),
        prior=_prior(scenario, motion, prior_rng),
        truth=Truth(frames_t_ns, motion.T_world_imu, motion.v_world, bias[last_sample]),
        gravity_world=scenario.gravity_world,
    )


class _View(NamedTuple):
    """The parts without noise: scene, stamps of the frames (K,), motion at them, visible landmarks (K, M)."""

    scene: Scene
    frames_t_ns: IntArray
    motion: Kinematics
    in_view: BoolArray


def _view(
    scene_of: SceneOf, duration_s: float, rig: StereoRig, camera: CameraLimits, drawn: np.random.Generator | None = None
) -> _View:
    scene = scene_of(duration_s) if drawn is None else scene_of(duration_s, drawn)
    frames_t_ns = sensors.stamps_ns(START_NS, camera.rate_hz, duration_s)
    motion = scene.trajectory.at((frames_t_ns - START_NS) / NS_PER_S)
    return _View(scene, frames_t_ns, motion, sensors.visibility(scene.points, motion.T_world_imu, rig, camera))


# What all seeds of a scenario share takes longer than the draws of a seed.
_view_of_all_seeds = lru_cache(maxsize=2)(_view)


def _measure_motion(
    scenario: Scenario, trajectory: SmoothTrajectory, frames_t_ns: IntArray, rng: np.random.Generator
) -> tuple[MotionSamples, Array]:
    sensor, scale = scenario.motion, scenario.noise_scale
    if isinstance(sensor, Imu):
        t_ns = sensors.imu_stamps_ns(START_NS, sensor.rate_hz, scenario.duration_s)
        motion = trajectory.at((t_ns - START_NS) / NS_PER_S)
        return sensors.measure_imu(sensor, scale, t_ns, motion, scenario.gravity_world, rng)
    # One stamp beyond the last frame, so that the last sample is a mean twist like every other.
    t_ns = np.append(frames_t_ns, frames_t_ns[-1] + round(NS_PER_S / scenario.camera.rate_hz))
    T_world_imu = trajectory.at((t_ns - START_NS) / NS_PER_S).T_world_imu
    return sensors.measure_twist(sensor, scale, t_ns, T_world_imu, rng)


def _observe(scenario: Scenario, view: _View, streams: list[np.random.Generator]) -> Observations:
    rig, camera = scenario.rig, scenario.camera
    tracks_rng, pixels_rng, outliers_rng, slips_rng = streams
    tracks = sensors.follow(view.in_view, camera, tracks_rng)
    exact = sensors.sightings(tracks, view.scene.points, view.motion.T_world_imu, rig)
    scale = scenario.noise_scale
    if scenario.track_noise is not None:
        exact, scale = sensors.with_track_noise(exact, scenario.track_noise.scaled(scale), pixels_rng), 0.0
    noisy = sensors.with_pixel_noise(exact, scale, rig.cov_uv_px2, camera.step_px, pixels_rng)
    noisy = sensors.with_outliers(noisy, camera, outliers_rng)
    if not scenario.slip_share:
        return noisy
    slipped = sensors.with_slips(noisy, scenario.slip_share, rig, slips_rng)
    return sensors.while_in_image(slipped, camera.size_px)


def _prior(scenario: Scenario, motion: Kinematics, rng: np.random.Generator) -> Prior:
    """Return a prior whose error is drawn from its own covariance; the biases' error is already in the sensor."""
    sensor = scenario.motion
    if isinstance(sensor, Imu):
        bias_sigma = sensor.bias_sigma
    else:
        bias_sigma = np.concatenate([np.full(3, _UNUSED_ACCEL_BIAS_SIGMA), sensor.gyro_bias_sigma])
    error = scenario.noise_scale * _PRIOR_SIGMA * rng.standard_normal(9)
    truth = motion.T_world_imu[0]
    pose_error = se3(so3_exp(error[:3]), error[3:6])
    return Prior(
        T_world_imu=truth @ pose_error,
        v_world=motion.v_world[0] + truth[:3, :3] @ error[6:],
        bias=np.zeros(6),
        cov=np.diag(np.concatenate([_PRIOR_SIGMA, bias_sigma]) ** 2),
        source="simulation: the truth, disturbed by an error drawn from its covariance",
    )


def _provenance(scenario: Scenario, seed: int) -> Provenance:
    camera = scenario.camera
    facts: tuple[str, ...] = (
        "the seed draws trajectory, landmarks and errors"
        if scenario.varied
        else "the trajectory and the landmarks belong to the scenario; the seed draws the errors",
        f"noise scale {scenario.noise_scale:g}, outlier rate {camera.outlier_rate:g}",
        f"image coordinates rounded to {camera.step_px:g} px" if camera.step_px else "image coordinates not rounded",
    )
    if scenario.track_noise is not None:
        facts += (
            "errors of a track are correlated, which the stated noise does not include (docs/tracks.md), and "
            f"{scenario.slip_share:.0%} of the tracks jump to another point",
        )
    return Provenance("simulated", f"scenario {scenario.name}, {scenario.duration_s:g} s, seed {seed}", facts)


def stereo_cov_px2(sigma_px: float) -> Array:
    """Return the covariance (3, 3) px^2 of (uL, uR, v) where every image coordinate has the same noise.

    v is the mean of the two images' rows and has half their variance.
    """
    return sigma_px**2 * np.diag([1.0, 1.0, 0.5])


def _drive_rig() -> StereoRig:
    """KITTI's geometry; the camera is mounted a little askew, so that a transposed extrinsic cannot pass."""
    R_forward_left_up_cam = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    R_imu_cam = so3_exp(np.array([0.006, -0.009, 0.012])) @ R_forward_left_up_cam
    T_imu_cam = se3(R_imu_cam, np.array([1.1, 0.3, 0.7]))
    return StereoRig(707.0, 707.0, 610.0, 185.0, 0.54, T_imu_cam, stereo_cov_px2(1.0))


def _flight_rig() -> StereoRig:
    """EuRoC's rectified left camera and its extrinsic (Burri et al. 2016), with 0.11 m of baseline."""
    x_axis = np.array([0.01486554298, 0.99955724901, -0.02577443670])
    y_axis = np.array([-0.99988092970, 0.01496721332, 0.00375618836])
    R_imu_cam = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)], axis=-1)
    # The published digits are orthonormal to 1e-10 only.
    T_imu_cam = se3(nearest_rotation(R_imu_cam)[0], np.array([-0.021640145, -0.064676987, 0.009810731]))
    return StereoRig(458.0, 457.0, 367.0, 248.0, 0.11, T_imu_cam, stereo_cov_px2(1.0))


# 0.05 m/s and 0.005 rad/s on a sample of 0.1 s. The gyro bias stays far below the audit's 0.003 rad/s.
_WHEEL_ODOMETER = Odometer(
    TwistNoise(np.full(3, 0.05 * np.sqrt(0.1)), np.full(3, 0.005 * np.sqrt(0.1)), np.full(3, 1e-5)),
    gyro_bias_sigma=np.full(3, 3e-4),
)
_CAR_IMU = Imu(100.0, ImuNoise(5e-3, 5e-4, 5e-4, 1e-5), bias_sigma=np.repeat([0.02, 3e-4], 3))
_EUROC_IMU = Imu(200.0, ImuNoise(2e-3, 1.7e-4, 3e-3, 1.9e-5), bias_sigma=np.repeat([0.02, 5e-4], 3))

# Audited seconds: over eight seeds no more faults are undecided after them than after all 60. Undecided remain the
# camera's position on `drive` (under one seed, and with the whole recording under six) and on `drive-imu`, and vision's
# scale with an IMU.
DRIVE = Scenario(
    name="drive",
    scene=road,
    rig=_drive_rig(),
    camera=CameraLimits(rate_hz=10.0, size_px=(1241, 376), depth_m=(3.0, 40.0), max_tracks=100, loss_per_frame=0.05),
    motion=_WHEEL_ODOMETER,
    audited_s=40.0,
)
DRIVE_IMU = replace(DRIVE, name="drive-imu", motion=_CAR_IMU, audited_s=40.0)
# Beyond 7 m the disparity would come within five standard deviations of zero.
FLIGHT = Scenario(
    name="flight",
    scene=hall,
    rig=_flight_rig(),
    camera=CameraLimits(rate_hz=20.0, size_px=(752, 480), depth_m=(0.8, 7.0), max_tracks=100, loss_per_frame=0.02),
    motion=_EUROC_IMU,
    has_surfaces=True,
    audited_s=20.0,
)
# Track noise fitted to real drives and to EuRoC's images, and the length of their tracks (docs/tracks.md).
DRIVE_REALISTIC = replace(
    DRIVE,
    name="drive-realistic",
    camera=replace(DRIVE.camera, depth_m=(4.0, 100.0), max_tracks=75, loss_per_frame=0.06),
    track_noise=TrackNoise(np.full(3, 0.02), np.array([0.09, 0.13, 0.11]), np.array([0.0, 0.9, 0.0])),
    slip_share=0.08,
    audited_s=None,
)
FLIGHT_REALISTIC = replace(
    FLIGHT,
    name="flight-realistic",
    camera=replace(FLIGHT.camera, max_tracks=120, loss_per_frame=0.05),
    track_noise=TrackNoise(np.full(3, 0.02), np.array([0.08, 0.12, 0.07]), np.array([0.0, 0.6, 0.0])),
    slip_share=0.04,
    audited_s=None,
)
SCENARIOS = {scenario.name: scenario for scenario in (DRIVE, DRIVE_IMU, FLIGHT, DRIVE_REALISTIC, FLIGHT_REALISTIC)}
