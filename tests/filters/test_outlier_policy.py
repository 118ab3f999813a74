"""How far a wrong sighting pulls an estimate: each estimator's policy towards outliers, by its name alone.

On an exact recording one sighting is moved by so many standard deviations, and the error it makes is read off: the
influence function of robust statistics (Hampel et al. 1986). It grows in proportion where a sighting counts in full,
stays where Huber's loss holds it, and is zero beyond a gate. A changed threshold moves one of the three.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.geometry import se3_inverse, se3_log
from toolkit.sequence import Sequence, is_held_out
from toolkit.settings import POLICIES, PolicyName, Settings, Window
from toolkit.simulation import DRIVE, simulate
from toolkit.simulation.scenarios import noise_free

# The frame whose sighting is wrong, and how long before and after it the track must have been seen.
FRAME, AROUND = 8, 4


class Scene(NamedTuple):
    """An exact recording, the rows of FRAME's sightings of long tracks, the nearest track first."""

    sequence: Sequence
    rows: list[int]

    def with_error(self, sigmas: float) -> Sequence:
        """Return the recording with one sighting off by so many standard deviations, to the side in both images."""
        observations, whitener = self.sequence.observations, np.linalg.cholesky(self.sequence.rig.cov_uv_px2)
        uv_px = observations.uv_px.copy()
        # Neither the nearest, whose landmark would follow it, nor a far one, which has little weight.
        uv_px[self.rows[len(self.rows) // 3]] += sigmas * (whitener @ np.array([1.0, 1.0, 0.0])) / np.sqrt(2.0)
        return replace(self.sequence, observations=replace(observations, uv_px=uv_px))

    def error_m(self, run: Run, frame: int = FRAME) -> float:
        """Return the error of a run's final position at a frame."""
        error = se3_inverse(run.final.T_world_imu[frame]) @ self.sequence.truth.T_world_imu[frame]
        return float(np.linalg.norm(se3_log(error)[3:]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    sequence = simulate(noise_free(replace(DRIVE, duration_s=1.3)), 0)
    seen = sequence.observations
    disparity_px = seen.uv_px[:, 0] - seen.uv_px[:, 1]
    rows = np.flatnonzero((seen.frame == FRAME) & ~is_held_out(seen.track_id))

    def is_long(row: int) -> bool:
        frames = seen.frame[seen.track_id == seen.track_id[row]]
        return bool(frames.min() <= FRAME - AROUND and frames.max() >= FRAME + AROUND)

    return Scene(sequence, sorted(filter(is_long, rows.tolist()), key=lambda row: -disparity_px[row]))


@pytest.fixture
def pull(scene, run_estimator) -> Callable[[str, float], float]:
    """Return a function: the error (m) of the final position at FRAME that a sighting off by some sigmas makes."""

    def pulled(name: str, sigmas: float, policy: PolicyName = "classic", weight: float = 1.0) -> float:
        settings, sequence = Settings(outliers=POLICIES[policy], window=WHOLE), scene.with_error(sigmas)
        sequence = replace(sequence, rig=replace(sequence.rig, track_weight=weight))
        return scene.error_m(run_estimator(name, sequence, settings=settings))

    return pulled


# Of what is exact a run leaves rounding, or where its iteration stops.
WHOLE = Window(lag_s=2.0)  # no sighting of the scene leaves it
NOTHING_M = 1e-6


# By estimator, policy and weight of tracks: how far a sighting off by some sigmas pulls, over the pull of one off by
# one sigma, to a share of it; and from where on it is dropped, if at all.
COUNTS_IN_FULL = {12.0: (12.0, 0.1)}
PULLS: dict[tuple[str, PolicyName, float], tuple[dict[float, tuple[float, float]], float | None]] = {
    # The whitener of ekf holds the landmark's variance as well, here as large as the sighting's: 1.5 becomes 2.1 sigma.
    ("ekf", "classic", 1.0): ({1.5: (1.5, 0.02), 3.5: (2.1, 0.1)}, 6.0),
    # The gate's 2.8 sigma are of an innovation that has the landmark's and the pose's variance in it too: 4.2.
    ("ekf-slam", "classic", 1.0): ({3.8: (3.8, 0.02)}, 5.0),
    ("iekf", "classic", 1.0): ({3.8: (3.8, 0.02)}, 5.0),
    # Loss and gate, 1.5 and 3.37 sigma of the innovation, have both variances in it: the loss begins at 2.1 sigma of
    # the sighting, the gate at 5.1. A joint filter counts a larger innovation with more noise, and moves the landmark
    # the less for it, so that its pull still grows up to the gate.
    ("ekf", "robust", 1.0): ({2.0: (2.0, 0.02), 4.8: (2.1, 0.05)}, 5.6),
    ("ekf-slam", "robust", 1.0): ({2.0: (2.0, 0.02), 4.8: (3.0, 0.05)}, 5.6),
    ("iekf", "robust", 1.0): ({2.0: (2.0, 0.02), 4.8: (3.0, 0.05)}, 5.6),
    # A smoother's fit takes a tenth of the residual. The gate's 3.37 sigma are of an innovation that has the variance
    # of the landmark in it, which was seen from farther away until then: 4.8 of the sighting, by the stated noise.
    ("fixed-lag", "robust", 1.0): ({1.5: (1.5, 0.02), 4.4: (1.67, 0.05)}, 5.3),
    ("isam2", "robust", 0.25): ({1.5: (1.5, 0.02), 4.4: (1.67, 0.05)}, 5.3),
    ("smart", "robust", 0.25): ({1.5: (1.5, 0.02), 4.4: (1.67, 0.05)}, 5.3),
    # The loss begins at the gate's bound of 2.8 sigma; beyond 7.9 it is an outlier.
    **{(name, "classic", 1.0): ({2.5: (2.5, 0.02), 6.5: (3.0, 0.1)}, 12.0) for name in ("fixed-lag", "isam2", "smart")},
    # A sound sighting is beyond 4.03 sigma once in a thousand; the filters' gate at 95 % would end at 2.8.
    ("batch", "classic", 1.0): ({3.7: (3.7, 0.02)}, 4.7),
    **{(name, "none", 1.0): (COUNTS_IN_FULL, None) for name in ("ekf-slam", "fixed-lag", "smart", "batch")},
    # The report's filter has no gate.
    ("seed-ekf", "classic", 1.0): (COUNTS_IN_FULL, None),
}


@pytest.mark.parametrize(("name", "policy", "weight"), PULLS)
def test_a_sighting_counts_in_full_is_held_and_is_dropped_where_the_policy_says(pull, name, policy, weight):
    ratios, dropped_at = PULLS[name, policy, weight]
    at_one = pull(name, 1.0, policy, weight)
    assert at_one > 10.0 * NOTHING_M
    for sigmas, (ratio, share) in ratios.items():
        assert pull(name, sigmas, policy, weight) / at_one == pytest.approx(ratio, rel=share)
    assert dropped_at is None or pull(name, dropped_at, policy, weight) < NOTHING_M


@pytest.mark.parametrize(("name", "in_view", "later"), [("msckf-fej", 3.2, 3.57), ("msckf-slam", 3.17, 3.47)])
def test_windowed_filters_weigh_a_sighting_in_view_and_later_its_track_by_the_common_policy(
    scene, run_estimator, name, in_view, later
):
    """Both losses begin beyond 2 sigma of the sighting: without them 4 sigma would pull 3.8 to 4.1 times as far.

    The window holds three poses. At FRAME the sighting corrects in view alone, by its own innovation. Four frames later
    it is in view no more, and what pulls is its track's correction of the window, or that of a landmark in the state.
    """
    settings = Settings(window=Window(lag_s=0.25))
    runs = {s: run_estimator(name, scene.with_error(s), settings=settings) for s in (1.0, 2.0, 4.0, 6.0)}
    for frame, held_at in ((FRAME, in_view), (FRAME + 4, later)):
        pulled = {sigmas: scene.error_m(run, frame) for sigmas, run in runs.items()}
        assert pulled[1.0] > 10.0 * NOTHING_M
        assert pulled[2.0] / pulled[1.0] == pytest.approx(2.0, rel=0.03)
        assert pulled[4.0] / pulled[1.0] == pytest.approx(held_at, rel=0.04)
        assert pulled[6.0] < NOTHING_M


def test_a_track_that_fails_its_gate_by_little_is_lost_and_one_that_jumped_is_tested_again(scene, run_estimator):
    """To give up the worst sighting of a track with bad luck would choose measurements by their agreement.

    The one track of five views fails from 6.7 sigma on, and is twice beyond its gate from 9.5 on.
    """

    def counted(sigmas: float) -> tuple[int, int]:
        settings = Settings(outliers=POLICIES["classic"], window=Window(lag_s=0.45))
        info = run_estimator("msckf", scene.with_error(sigmas), settings=settings).info
        return int(info["gate_tested"].sum()), int(info["gate_accepted"].sum())

    tested, accepted = counted(0.0)
    assert tested == accepted
    assert counted(5.5) == (tested, accepted)
    assert counted(8.0) == (tested, accepted - 1)
    assert counted(12.0) == (tested + 1, accepted)


def test_a_doubtful_pose_does_not_harden_the_decoupled_map(scene, run_estimator):
    """Four landmarks leave the pose as doubtful as they are: mapped along known poses each would be a quarter surer."""
    rows = scene.rows[:4]
    seen = scene.sequence.observations
    few = seen.select(np.isin(seen.track_id, seen.track_id[rows]))
    sequence = replace(scene.sequence, observations=few)

    def variances(run: Run) -> np.ndarray:
        return np.trace(run.landmarks.cov, axis1=1, axis2=2)

    doubtful, known = (variances(run_estimator(name, sequence)) for name in ("ekf", "mapping"))
    assert len(doubtful) == len(rows)
    assert (doubtful > 1.15 * known).all()
