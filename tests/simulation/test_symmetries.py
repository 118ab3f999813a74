"""A turned, mirrored or reversed recording is a sound one: its motion and its images are those of its truth."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.initialization import start_from_truth
from toolkit.models import stereo
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, faults, noise_free, simulate
from toolkit.simulation.symmetries import delayed, mirrored, reversed_in_time, turned
from toolkit.verify.verification import short

SEED = 4
RETOLD = {
    "turned": lambda sequence: turned(sequence, 2.0, np.array([30.0, -20.0, 5.0])),
    "delayed": lambda sequence: delayed(sequence, 10**18),
    "mirrored": mirrored,
    "reversed": reversed_in_time,
    "mirrored and reversed": lambda sequence: reversed_in_time(mirrored(sequence)),
}
# Samples of an IMU at 1 kHz are integrated by the midpoint rule, which errs by up to 1e-6 m in such recordings; what is
# left of twists is rounding, and of pixels by poses of a spline and triangulation from images without noise as well.
WITHIN_M, WITHIN_PX = 5e-6, 1e-5


def exact(scenario: str) -> Sequence:
    return simulate(noise_free({"drive": short(DRIVE, 1.5), "flight": short(FLIGHT, 1.0)}[scenario]), SEED)


@pytest.mark.parametrize("how", RETOLD)
@pytest.mark.parametrize("scenario", ["drive", "flight"])
def test_its_motion_samples_lead_along_its_truth(scenario: str, how: str, run_estimator) -> None:
    sequence = RETOLD[how](exact(scenario))
    run = run_estimator("dead-reckoning", sequence, start_from_truth(sequence))
    np.testing.assert_array_equal(sequence.truth.t_ns, sequence.frames_t_ns)
    np.testing.assert_allclose(run.final.positions, sequence.truth.T_world_imu[:, :3, 3], rtol=0, atol=WITHIN_M)


@pytest.mark.parametrize("how", RETOLD)
@pytest.mark.parametrize("scenario", ["drive", "flight"])
def test_its_images_are_those_of_points_that_stand_still(scenario: str, how: str) -> None:
    sequence = RETOLD[how](exact(scenario))
    seen, poses = sequence.observations, sequence.truth.T_world_imu
    _, first, track = np.unique(seen.track_id, return_index=True, return_inverse=True)
    points = stereo.triangulate_world(seen.uv_px[first], poses[seen.frame[first]], sequence.rig)
    predicted = stereo.predict(points[track], poses[seen.frame], sequence.rig)
    np.testing.assert_allclose(seen.uv_px, predicted.uv_px, rtol=0, atol=WITHIN_PX)


@pytest.mark.parametrize("how", [mirrored, reversed_in_time])
def test_transformed_twice_it_is_the_recording_again(how) -> None:
    sequence = replace(exact("flight"), prior=None)
    again = how(how(sequence))
    np.testing.assert_array_equal(again.frames_t_ns, sequence.frames_t_ns)
    np.testing.assert_array_equal(again.motion.values, sequence.motion.values)
    # Columns that are counted from the other side and back, and a baseline that is added and taken away.
    np.testing.assert_allclose(again.observations.uv_px, sequence.observations.uv_px, rtol=1e-14)
    np.testing.assert_allclose(again.rig.T_imu_cam, sequence.rig.T_imu_cam, rtol=0, atol=1e-15)


def test_sightings_by_the_left_camera_alone_have_no_mirror_image() -> None:
    with pytest.raises(DataError, match="leave them out"):
        mirrored(faults.missing_right(exact("drive"), 0.3, SEED))
