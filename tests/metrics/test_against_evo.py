"""ATE and RPE equal evo's (GPL, a test dependency only) to 1e-9 on exactly matched stamps."""

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D

from tests.metrics.conftest import drive_poses, make_run, make_sequence, perturb
from toolkit.geometry import se3, se3_exp
from toolkit.metrics import score_run

# Sums of a few hundred squares of hundreds of metres in double precision keep about 1e-12; evo goes through the
# same SVD in another order.
TOLERANCE = 1e-9
POSITION, ANGLE_DEG = PoseRelation.translation_part, PoseRelation.rotation_angle_deg


@pytest.fixture
def case():
    """A drive of 260 m and an estimate with drift, a scale error and a world of its own."""
    truth = drive_poses(260)
    sequence = make_sequence(truth, track_count=3)
    drifted = perturb(truth, 5e-3, seed=2)
    drifted = se3(drifted[:, :3, :3], 1.03 * drifted[:, :3, 3])
    estimate = se3_exp(np.array([0.4, -1.1, 2.0, 30.0, -50.0, 7.0])) @ drifted
    return sequence, truth, estimate, score_run(make_run(sequence.frames_t_ns, estimate), "final", sequence).values


def evo_trajectory(sequence, poses):
    return PoseTrajectory3D(poses_se3=list(poses.copy()), timestamps=sequence.frames_t_ns / 1e9)


def evo_rmse(metric, reference, estimate):
    metric.process_data((reference, estimate))
    return np.sqrt(np.mean(metric.error**2))


@pytest.mark.parametrize("key", ["ate_none_m", "ate_se3_m", "ate_sim3_m", "ate_se3_deg"])
def test_ate_equals_evo(case, key):
    sequence, truth, estimate, ours = case
    reference, other = evo_trajectory(sequence, truth), evo_trajectory(sequence, estimate)
    if key == "ate_none_m":
        other.align_origin(reference)
    else:
        other.align(reference, correct_scale=key == "ate_sim3_m")
    relation = ANGLE_DEG if key.endswith("deg") else POSITION
    assert ours[key] == pytest.approx(evo_rmse(APE(relation), reference, other), rel=TOLERANCE)
    assert ours[key] > 0.1


@pytest.mark.parametrize(("key", "relation"), [("rpe_1s_m", POSITION), ("rpe_1s_deg", ANGLE_DEG)])
def test_rpe_over_one_second_equals_evo_over_ten_frames(case, key, relation):
    sequence, truth, estimate, ours = case
    metric = RPE(relation, delta=10, delta_unit=Unit.frames, all_pairs=True)
    theirs = evo_rmse(metric, evo_trajectory(sequence, truth), evo_trajectory(sequence, estimate))
    assert ours[key] == pytest.approx(theirs, rel=TOLERANCE)


def test_rpe_over_100_m_equals_evo_over_the_same_pairs(case):
    _, truth, estimate, ours = case
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    # evo takes the pair nearest to 100 m, we the first beyond it: hand evo's formula our pairs, found by a loop.
    squares = []
    for i in range(len(truth)):
        beyond = [j for j in range(i, len(truth)) if path_m[j] >= path_m[i] + 100.0]
        if beyond:
            error = RPE.rpe_base(truth[i], truth[beyond[0]], estimate[i], estimate[beyond[0]])
            squares.append(error[:3, 3] @ error[:3, 3])
    assert ours["rpe_100m_percent"] == pytest.approx(np.sqrt(np.mean(squares)), rel=TOLERANCE)
