"""A window that may not hold every frame's state: filters and smoothers thin alike, evenly, and leave no frame out."""

from dataclasses import replace

import numpy as np
import pytest

from filters.dead_reckoning import DeadReckoning
from filters.kalman.online_output import OnlineOutput
from filters.kalman.thinning import Thinned
from toolkit import runner
from toolkit.estimate import Estimate, Trajectory
from toolkit.estimator import Setup
from toolkit.geometry import se3_inverse, se3_log
from toolkit.measurements import Packet
from toolkit.registry import find
from toolkit.settings import Settings, Window
from toolkit.simulation import DRIVE, FLIGHT, noise_free, simulate

WINDOWED = ("msckf", "msckf-fej", "msckf-slam", "fixed-lag", "smart")


@pytest.fixture(scope="module")
def flight():
    camera = replace(FLIGHT.camera, max_tracks=40)
    return simulate(noise_free(replace(FLIGHT, duration_s=2.0, camera=camera)), 0)


class Listener(DeadReckoning):
    """Integrates the motion it is given, from the truth, and remembers the packets."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.packets: list[Packet] = []

    def step(self, packet: Packet) -> Estimate:
        self.packets.append(packet)
        return super().step(packet)


def thinned(sequence, window):
    setup = runner.setup_of(sequence, sequence.prior, Settings(window=window))
    listener = Listener(setup)
    wrapped = Thinned(setup, OnlineOutput(listener))
    online = [wrapped.step(packet) for packet in sequence.packets()]
    return listener, online, wrapped.finish().trajectory


# 20 frames a second: a second's window has 21, and then every frame has a state.
@pytest.mark.parametrize("most_states", [2, 5, 20, 21])
def test_no_window_holds_more_states_than_its_most_and_they_are_evenly_apart(flight, most_states):
    listener, _, _ = thinned(flight, Window(lag_s=1.0, most_states=most_states))
    t_s = np.array([packet.frame.t_ns - flight.frames_t_ns[0] for packet in listener.packets]) / 1e9
    held = [int(((t_s >= now - 1.0 - 1e-9) & (t_s <= now)).sum()) for now in t_s]
    assert max(held) <= most_states
    assert max(held) >= most_states - 1
    # To within a frame.
    assert np.abs(np.diff(t_s) - 1.0 / (most_states - 1)).max() < 0.05 + 1e-9
    assert [packet.index for packet in listener.packets] == list(range(len(t_s)))


@pytest.mark.parametrize("motion_kind", ["imu", "twist", "none"])
def test_by_default_every_frame_of_a_camera_at_20_hz_has_a_state(motion_kind):
    """With stamps that err by a millisecond: the cap's intervals leave room for it."""
    jitter_ns = np.random.default_rng(0).integers(-1_000_000, 1_000_000, 400)
    t_ns = 50_000_000 * np.arange(400) + jitter_ns
    intervals = [Window().interval(int(since_ns), motion_kind) for since_ns in t_ns - t_ns[0]]
    assert len(set(intervals)) == len(intervals)


def test_frames_without_a_state_are_carried_on_from_the_state_before_them(flight):
    """With nothing left out of the motion, which is exact to 1 kHz's midpoint rule."""
    listener, online, final = thinned(flight, Window(lag_s=1.0, most_states=5))
    assert len(listener.packets) < len(online) == flight.frame_count
    np.testing.assert_array_equal(final.t_ns, flight.frames_t_ns)
    for trajectory in (Trajectory.of(online), final):
        error = se3_log(se3_inverse(flight.truth.T_world_imu) @ trajectory.T_world_imu)
        assert np.abs(error).max() < 1e-5
        grown = np.linalg.det(trajectory.cov[1:, :6, :6]) > np.linalg.det(trajectory.cov[:-1, :6, :6])
        assert grown.all()


@pytest.mark.parametrize("most_states", [1, 5])
@pytest.mark.parametrize("name", WINDOWED)
def test_windowed_filters_and_smoothers_answer_for_every_frame_under_a_cap(name, most_states):
    sequence = simulate(replace(DRIVE, duration_s=2.0, camera=replace(DRIVE.camera, max_tracks=30)), 3)
    settings = Settings(window=Window(lag_s=1.0, most_states=most_states))
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.status == "ok", run.log
    for trajectory in (run.causal, run.final):
        np.testing.assert_array_equal(trajectory.t_ns, sequence.frames_t_ns)
        assert trajectory.cov is not None
        error_m = np.linalg.norm(trajectory.positions - sequence.truth.T_world_imu[:, :3, 3], axis=1)
        assert error_m.max() < 0.3
