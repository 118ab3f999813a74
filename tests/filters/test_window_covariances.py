"""The final covariance of a state is the one the window had for it when it was last in there."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters import smart
from filters.fixed_lag import FixedLag
from filters.smart import Smart
from filters.smoothing.fixed_lag_tree import FixedLagTree
from filters.smoothing.indeterminate import without_gaps
from tests.filters.conftest import assert_covariances_agree, setup_of
from toolkit.errors import EstimatorError
from toolkit.measurements import NS_PER_S
from toolkit.models.motion import motion_model
from toolkit.models.stereo_adjustment import without_oldest
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate

FEW_TRACKS = {"max_tracks": 25}
SCENARIOS = [
    replace(s, duration_s=d, camera=replace(s.camera, **FEW_TRACKS))
    for s, d in ((DRIVE, 3.0), (DRIVE_IMU, 3.0), (FLIGHT, 1.5))
]
LAG_S = 0.5
GAP = (12, 25)


def with_gap(sequence: Sequence) -> Sequence:
    """Return a recording that lacks more than a lag of frames: the whole window leaves at once."""
    kept = np.setdiff1d(np.arange(sequence.frame_count), np.arange(*GAP))
    seen = sequence.observations.select(np.isin(sequence.observations.frame, kept))
    renumbered = Observations.sorted(np.searchsorted(kept, seen.frame), seen.track_id, seen.uv_px)
    return replace(sequence, frames_t_ns=sequence.frames_t_ns[kept], observations=renumbered)


def run_through(estimator, sequence):
    for packet in sequence.packets():
        estimator.step(packet)
    return estimator.finish().trajectory


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_fixed_lag_states_leave_with_gtsams_marginals_of_the_windows_factors(scenario, monkeypatch):
    sequence = with_gap(simulate(scenario, 3))
    motion, last = motion_model(sequence.noise, sequence.gravity_world), {}
    add = FixedLagTree.add

    def spied(window, extension, t_ns):
        recovery, tree = add(window, extension, t_ns), window._isam
        marginals = gtsam.Marginals(without_gaps(tree.getFactorsUnsafe()), tree.getLinearizationPoint())
        for k, stamp_ns in enumerate(sequence.frames_t_ns.tolist()):
            if t_ns - round(LAG_S * NS_PER_S) <= stamp_ns <= t_ns:
                R_world_imu = window.values().atPose3(motion.keys(k)[0]).rotation().matrix()
                last[k] = motion.state_cov(marginals, k, R_world_imu)
        return recovery

    monkeypatch.setattr(FixedLagTree, "add", spied)
    final = run_through(FixedLag(setup_of(sequence), LAG_S), sequence)
    # Both invert the same normal equations, whose rounding grows with their condition.
    assert_covariances_agree(final.cov, np.array([last[k] for k in range(len(final))]), 1e-5)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_smart_states_leave_with_the_inverse_of_the_windows_information(scenario, monkeypatch):
    sequence, last = with_gap(simulate(scenario, 3)), {}
    taken_in, solved = [], smart.solve_window

    def spied(window, camera, ending):
        solution = solved(window, camera, ending)
        taken_in.append(solution)
        inverse = np.linalg.inv(solution.root @ solution.root.T)
        count, d = len(window.keys), window.size
        for i in range(count):
            last[len(taken_in) - count + i] = inverse[i * d : (i + 1) * d, i * d : (i + 1) * d]
        return solution

    monkeypatch.setattr(smart, "solve_window", spied)
    final = run_through(Smart(setup_of(sequence), LAG_S), sequence)
    expected = np.array([last[k] for k in range(len(final))])
    if sequence.motion_kind == "imu":
        to_body = np.tile(np.eye(15), (len(final), 1, 1))
        to_body[:, 6:9, 6:9] = np.swapaxes(final.T_world_imu[:, :3, :3], 1, 2)
        expected = to_body @ expected @ np.swapaxes(to_body, 1, 2)
    assert_covariances_agree(final.cov, expected, 1e-5)


def test_states_that_leave_together_leave_as_one_by_one(monkeypatch):
    sequence, windows = simulate(SCENARIOS[2], 3), []
    monkeypatch.setattr(smart, "without_oldest", lambda *a: windows.append(a) or without_oldest(*a))
    run_through(Smart(setup_of(sequence), LAG_S), sequence)
    window, _, rig = windows[-1]
    together, one_by_one = without_oldest(window, 3, rig), window
    for _ in range(3):
        one_by_one = without_oldest(one_by_one, 1, rig)
    assert together.keys == one_by_one.keys
    scale = np.abs(together.prior.information).max()
    np.testing.assert_allclose(together.prior.information, one_by_one.prior.information, atol=1e-9 * scale)
    scale = np.abs(together.prior.vector).max()
    np.testing.assert_allclose(together.prior.vector, one_by_one.prior.vector, atol=1e-6 * scale)
    np.testing.assert_array_equal(together.sightings.point, one_by_one.sightings.point)


def test_a_window_started_afresh_leaves_no_state_without_a_covariance(monkeypatch):
    """After a window of eight states was refused, once."""
    sequence, solved, refused = simulate(SCENARIOS[2], 3), smart.solve_window, []

    def solve_window(window, camera, ending):
        if len(window.keys) == 8 and not refused:
            refused.append(window)
            raise EstimatorError("nothing determines it")
        return solved(window, camera, ending)

    monkeypatch.setattr(smart, "solve_window", solve_window)
    final = run_through(Smart(setup_of(sequence), LAG_S), sequence)
    assert refused
    assert np.linalg.eigvalsh(final.cov).min() > 0.0
