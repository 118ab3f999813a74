"""The scale of disparities in batch: its derivatives, that a planted one is found, and what it leaves uncertain."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing.robust_loss import Cauchy, Huber, Squares
from filters.smoothing.scale_state import ScaleState
from filters.smoothing.track_chain import ChainedFactors, ChainedSightings
from toolkit.geometry import se3_exp, transform
from toolkit.measured_motion import NoSamples
from toolkit.metrics import score_run
from toolkit.models import stereo
from toolkit.models.factors import SCALE, L, StereoFactors, X, joint_cov, kind_of
from toolkit.models.motion import motion_model, state_cov, state_keys
from toolkit.models.noise import unmeasured_motion
from toolkit.models.state_covariances import covs_beside
from toolkit.models.stereo import scaled_rig
from toolkit.sequence import StereoFrame
from toolkit.settings import Noise, Settings
from toolkit.simulation import DRIVE, simulate
from toolkit.simulation.track_faults import disparity_scale
from toolkit.track_noise import TrackNoise

TRACK_NOISE = TrackNoise(np.array([0.1, 0.2, 0.1]), np.array([0.3, 0.2, 0.3]), np.array([0.0, 1.4, 0.0]))
WHITE_RIG = replace(DRIVE.rig, cov_uv_px2=np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.05], [0.0, 0.05, 0.3]]))
RIGS = {"white": WHITE_RIG, "chained": replace(WHITE_RIG, track_noise=TRACK_NOISE)}
LOSSES = {"squares": Squares(), "huber": Huber(1.5), "cauchy": Cauchy(2.0)}
POSES, POINTS = 4, 6
DIMENSIONS = {"x": 6, "l": 3, "s": 1}
WITH_SCALE = Settings(noise=Noise(disparity_scale=0.01))


@pytest.fixture(scope="module")
def scene():
    """Return frames whose disparities are 3 % longer, and values near to them that have a scale of 1 %."""
    rng = np.random.default_rng(3)
    poses = se3_exp(0.05 * rng.standard_normal((POSES, 6)))
    points_cam = np.column_stack([rng.uniform(-2.0, 2.0, (POINTS, 2)), rng.uniform(8.0, 16.0, POINTS)])
    points, ids = transform(WHITE_RIG.T_imu_cam, points_cam), np.arange(POINTS)
    frames, values = [], gtsam.Values()
    for k, pose in enumerate(poses):
        uvs_px = stereo.predict(points, pose, scaled_rig(WHITE_RIG, 0.03)).uv_px + rng.standard_normal((POINTS, 3))
        frames.append(StereoFrame(k, ids, uvs_px, np.full(POINTS, k)))
        values.insert(X(k), gtsam.Pose3(pose))
    for i, point in enumerate(points):
        values.insert(L(i), point)
    values.insert(SCALE, np.array([0.01]))
    return frames, values


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("rig", RIGS)
def test_the_linear_factors_have_the_gradient_of_the_cost(scene, rig, loss):
    frames, values = scene
    sightings = ChainedFactors(ChainedSightings.of(frames, RIGS[rig]), RIGS[rig], LOSSES[loss])
    gradient = sightings.linearised(values).linearize(values).gradientAtZero()
    rng, step = np.random.default_rng(0), 1e-6
    for _ in range(3):
        along = {key: rng.standard_normal(DIMENSIONS[kind_of(key)]) for key in values.keys()}  # noqa: SIM118
        # By itself the scale turns the cost by a thousand times as much as all poses: a hundredth of it shows both.
        along[SCALE] *= 0.01
        slope = sum(gradient.at(key) @ d for key, d in along.items())
        ahead, behind = (sightings.error(moved(values, along, s)) for s in (step, -step))
        # What is left is the kink of Huber's second derivative, in proportion to the step.
        assert (ahead - behind) / (2.0 * step) == pytest.approx(slope, rel=1e-5)


def moved(values, along, factor):
    delta = gtsam.VectorValues()
    for key, direction in along.items():
        delta.insert(key, factor * direction)
    return values.retract(delta)


def test_without_memory_and_scale_the_sightings_are_gtsams_stereo_factors(scene):
    frames, values = scene
    values = values.extract([key for key in values.keys() if key != SCALE])  # noqa: SIM118 - not a mapping
    graph = gtsam.NonlinearFactorGraph()
    for k, frame in enumerate(frames):
        for factor in StereoFactors(WHITE_RIG).of(frame, k):
            graph.add(factor)
    own = ChainedFactors(ChainedSightings.of(frames, WHITE_RIG), WHITE_RIG, Squares())
    assert own.error(values) == pytest.approx(graph.error(values), rel=1e-12)
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    native, vector = graph.linearize(values).hessian(ordering)
    by_rows, own_vector = own.linearised(values).linearize(values).hessian(ordering)
    # Rounding, relative to the largest entry.
    np.testing.assert_allclose(by_rows, native, atol=1e-11 * np.abs(native).max())
    np.testing.assert_allclose(own_vector, vector, atol=1e-11 * np.abs(vector).max())


def test_states_and_scale_have_the_covariance_of_gtsams_marginals():
    """The states' is that with the scale known, widened by what its own uncertainty moves them."""
    motion = motion_model(DRIVE.motion.noise, DRIVE.gravity_world)
    rng, graph, poses = np.random.default_rng(4), gtsam.GaussianFactorGraph(), np.tile(np.eye(4), (12, 1, 1))
    unit, keys = gtsam.noiseModel.Unit.Create(20), [state_keys(motion, k) for k in range(len(poses))]
    graph.add(SCALE, 100.0 * np.eye(1), np.zeros(1), gtsam.noiseModel.Unit.Create(1))
    for k, (pose, bias) in enumerate(keys):
        at = [(pose, rng.standard_normal((20, 6))), (bias, rng.standard_normal((20, 3))), (SCALE, np.ones((20, 1)))]
        before = [(pose_before, rng.standard_normal((20, 6))) for pose_before, _ in keys[k - 1 : k]]
        terms = before + at
        graph.add(gtsam.JacobianFactor(gtsam.GaussianConditional(terms, len(terms), np.zeros(20), unit)))
    covs, of_scale = covs_beside(graph, motion, poses, (SCALE,))
    tree = graph.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(graph))
    assert of_scale[0, 0] == pytest.approx(joint_cov(tree, [SCALE])[0, 0], rel=1e-9)
    for k in (0, 5, 11):
        np.testing.assert_allclose(covs[k], state_cov(motion, tree, k, np.eye(3)), rtol=1e-7, atol=1e-9)


def scale_reported(run):
    """Return the scale and its sigma as the log of a run has them."""
    words = run.log[0].split()
    return 0.01 * float(words[2]), 0.01 * float(words[4])


@pytest.mark.parametrize(("planted", "seed"), [(0.015, 0), (0.0, 2)])
def test_a_planted_scale_is_found_within_its_sigmas_and_the_path_is_as_long_as_it_was(planted, seed, run_estimator):
    sequence = disparity_scale(simulate(replace(DRIVE, duration_s=3.0), seed), planted)
    without, run = run_estimator("batch", sequence), run_estimator("batch", sequence, settings=WITH_SCALE)
    found, sigma = scale_reported(run)
    assert 0.0 < sigma < 0.003  # 0.05 m/s over 30 samples of 9 m/s would tell 0.0010, less what the tracks take of it
    assert abs(found - planted) < 3.0 * sigma
    errors_m = [score_run(one, "final", sequence, only=["ate_none_m"]).values["ate_none_m"] for one in (without, run)]
    if planted:
        assert errors_m[1] < 0.5 * errors_m[0]
    else:
        assert errors_m[1] < 1.5 * errors_m[0]


def test_images_alone_do_not_tell_the_scale(run_estimator):
    """It stays at its prior, and the poses are as uncertain as that makes the way from the start."""
    sequence = disparity_scale(simulate(replace(DRIVE, duration_s=2.0), 0), 0.01)
    images = replace(sequence, motion=NoSamples(sequence.frames_t_ns), noise=unmeasured_motion())
    known, run = (run_estimator("batch", images, settings=settings) for settings in (Settings(), WITH_SCALE))
    found, sigma = scale_reported(run)
    assert sigma > 0.0095 and abs(found) < 0.002
    assert "do not determine it" in run.log[0]
    travelled_m = np.linalg.norm(images.truth.T_world_imu[-1, :3, 3] - images.truth.T_world_imu[0, :3, 3])
    widened = np.trace(run.final.cov[-1][3:6, 3:6]) - np.trace(known.final.cov[-1][3:6, 3:6])
    assert np.sqrt(widened) == pytest.approx(0.01 * travelled_m, rel=0.2)


def test_what_the_scale_came_to_is_reported_with_its_prior():
    assert "+1.20 +- 0.30 % longer than the rig's (prior 0 +- 1 %)" in ScaleState(0.01).message_of(0.012, 0.003)
