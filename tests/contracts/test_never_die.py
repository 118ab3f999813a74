"""No estimator dies of what a recording may hold: standstill, blackout, bad tracks, no vision at the start, hardly any.

A run may say that it diverged, and why; it may not fail. When the trouble is over a sound rung of the ladder must be
of use again, which is to say better than not to look.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.errors import EstimatorError
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, about_z, se3_inverse, so3_exp
from toolkit.measurements import TwistNoise
from toolkit.registry import discover, find
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import FLIGHT, Scenario, simulate
from toolkit.simulation.scenes import FreeTrajectory, RotationSpline, Scene, UniformKnots, VectorSpline, room
from toolkit.simulation.sensors import Odometer
from toolkit.verify import gave_up

HALT_AT_S, HALT_S, MOVING_S, RATE_HZ = 4.0, 30.0, 10.0, 3.0
KNOT_S, MARGIN = 0.2, 4
# Wheels this poor drift by decimetres in ten seconds, far beyond what chance does to an estimator that sees.
ODOMETER = Odometer(TwistNoise(np.full(3, 0.1), np.full(3, 0.01), np.full(3, 1e-5)), gyro_bias_sigma=np.full(3, 2e-3))
SEED = 3
# Below it stands the report's filter, which believes that it knows its landmarks exactly.
LOWEST_SOUND_RUNG = 20
# One draw of the noise: who has only just recovered may, by chance, be a little further off than dead reckoning.
CHANCE = 1.25


def scene_along(progress: Callable[[Array], Array], duration_s: float) -> Scene:
    """Return a flight through a room, turning at half a radian a second, with its clock slowed or stopped at will."""
    count = int(np.ceil(duration_s / KNOT_S)) + 4 * MARGIN
    knots = UniformKnots(-MARGIN * KNOT_S, KNOT_S)
    s = progress(knots.start_s + KNOT_S * np.arange(count))
    position = np.stack(
        [2.0 * np.sin(0.45 * s), 1.8 * np.sin(0.6 * s + 1.0), 2.1 + 0.6 * np.sin(0.8 * s + 0.5)], axis=-1
    )
    zero = np.zeros_like(s)
    tilt = so3_exp(np.stack([0.2 * np.sin(1.4 * s), 0.2 * np.sin(1.1 * s), zero], axis=-1))
    upright_to_imu = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    trajectory = FreeTrajectory(
        VectorSpline(knots, position), RotationSpline(knots, about_z(0.5 * s) @ tilt @ upright_to_imu)
    )
    return Scene(
        trajectory, room(np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 4.5]), 800, np.random.default_rng(1))
    )


def moving(duration_s: float) -> Scene:
    return scene_along(lambda t_s: t_s, duration_s)


def halting(duration_s: float) -> Scene:
    return scene_along(lambda t_s: t_s - np.clip(t_s - HALT_AT_S, 0.0, HALT_S), duration_s)


def recorded(kind: str, scene: Callable[[float], Scene], duration_s: float, tracks: int) -> Sequence:
    motion = replace(FLIGHT.motion, rate_hz=100.0) if kind == "imu" else ODOMETER
    camera = replace(FLIGHT.camera, rate_hz=RATE_HZ, max_tracks=tracks)
    scenario: Scenario = replace(FLIGHT, scene=scene, motion=motion, camera=camera, duration_s=duration_s)
    return simulate(scenario, SEED)


def standstill(kind: str) -> Sequence:
    """Four seconds of motion, thirty of none, four of motion."""
    return recorded(kind, halting, HALT_AT_S + HALT_S + 4.0, 12)


def blackout(kind: str) -> Sequence:
    """Three seconds of empty frames, after which every track is a new one."""
    sequence = recorded(kind, moving, MOVING_S, 20)
    seen = sequence.observations
    before, after = seen.frame < 4 * RATE_HZ, seen.frame >= 7 * RATE_HZ
    ids = np.where(after, seen.track_id + 10_000, seen.track_id)
    return replace(sequence, observations=replace(seen, track_id=ids).select(before | after))


def blind_start(kind: str) -> Sequence:
    """Nothing seen in the first three seconds."""
    sequence = recorded(kind, moving, MOVING_S, 20)
    return replace(sequence, observations=sequence.observations.select(sequence.observations.frame >= 3 * RATE_HZ))


def negative_disparity(kind: str) -> Sequence:
    """One track in eight has its images swapped throughout, and one sighting in forty of the others."""
    sequence = recorded(kind, moving, MOVING_S, 20)
    seen = sequence.observations
    swapped = (seen.track_id % 8 == 0) | (np.arange(len(seen)) % 40 == 0)
    uv_px = np.where(swapped[:, None], seen.uv_px[:, [1, 0, 2]], seen.uv_px)
    return replace(sequence, observations=replace(seen, uv_px=uv_px))


def behind_the_camera(kind: str) -> Sequence:
    """A tracker that uses its ids again: tracks of the first two seconds come back when the camera looks away."""
    sequence = recorded(kind, moving, MOVING_S, 20)
    seen = sequence.observations
    early = np.setdiff1d(seen.track_id[seen.frame < 2 * RATE_HZ], seen.track_id[seen.frame >= 3 * RATE_HZ])
    late = np.setdiff1d(seen.track_id[seen.frame >= 7 * RATE_HZ], seen.track_id[seen.frame < 7 * RATE_HZ])
    count = min(len(early), len(late)) // 2
    assert count >= 5
    new_id = dict(zip(late[:count].tolist(), early[:count].tolist(), strict=True))
    ids = np.array([new_id.get(i, i) for i in seen.track_id.tolist()])
    return replace(sequence, observations=Observations.sorted(seen.frame, ids, seen.uv_px))


def hardly_a_track(kind: str) -> Sequence:
    """One or two tracks a frame, sometimes none."""
    return recorded(kind, moving, MOVING_S, 2)


# Every case with the kind of motion that makes it hard; the blackout is hard with both.
TOGETHER = [
    *((standstill, "imu"), (blackout, "imu"), (blackout, "twist"), (blind_start, "twist")),
    *((negative_disparity, "twist"), (behind_the_camera, "imu"), (hardly_a_track, "imu")),
]


@cache
def sequence_of(case: Callable[[str], Sequence], kind: str) -> Sequence:
    return case(kind)


def error_since_recovery_m(trajectory: Trajectory, sequence: Sequence) -> float:
    """Return the RMSE of the position over the last three seconds, relative to the pose at their start.

    By then every trouble is over, and what it has cost, to one as to the other, is not counted.
    """
    last = np.s_[-int(3 * RATE_HZ) :]
    relative, true = (se3_inverse(T[last][0]) @ T[last] for T in (trajectory.T_world_imu, sequence.truth.T_world_imu))
    return float(np.sqrt(np.square(relative[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def answer(run_estimator):
    """Return a function that runs an estimator once on a case."""

    @cache
    def run(name: str, case: Callable[[str], Sequence], kind: str):
        try:
            find(name).load()
        except EstimatorError as unavailable:
            pytest.skip(str(unavailable))
        return run_estimator(name, sequence_of(case, kind))

    return run


@pytest.mark.parametrize(("case", "kind"), TOGETHER, ids=[f"{case.__name__} with {kind}" for case, kind in TOGETHER])
@pytest.mark.parametrize("name", sorted(discover()))
def test_it_goes_on_to_the_end_and_a_sound_rung_recovers(name, case, kind, answer):
    sequence, run = sequence_of(case, kind), answer(name, case, kind)
    assert gave_up(run, sequence.frames_t_ns) == ""
    if (discover()[name].rung() or 0) < LOWEST_SOUND_RUNG:
        return
    limit_m = CHANCE * error_since_recovery_m(answer("dead-reckoning", case, kind).final, sequence)
    for trajectory in (run.causal, run.final):
        if trajectory is not None:
            assert error_since_recovery_m(trajectory, sequence) <= limit_m
