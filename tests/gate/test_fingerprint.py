"""The fingerprint tells measurements apart, and not the processors that made them."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.gate.measuring import fingerprint
from toolkit.sequence import Observations
from toolkit.simulation import FLIGHT, simulate

SHORT = replace(FLIGHT, duration_s=1.0)


@pytest.fixture(scope="module")
def flight():
    return simulate(SHORT, 0)


def test_the_same_seed_has_the_same_fingerprint_and_another_has_another(flight):
    assert fingerprint(simulate(SHORT, 0)) == fingerprint(flight)
    assert len({fingerprint(simulate(SHORT, seed)) for seed in range(5)}) == 5


def test_last_bits_do_not_change_it(flight):
    motion, rng = flight.motion, np.random.default_rng(0)
    nearly = replace(
        motion,
        accel_mps2=motion.accel_mps2 * (1.0 + 1e-15 * rng.standard_normal(motion.accel_mps2.shape)),
        gyro_radps=motion.gyro_radps * (1.0 + 1e-15 * rng.standard_normal(motion.gyro_radps.shape)),
    )
    other = replace(flight, motion=nearly)
    assert other.content_hash() != flight.content_hash()
    assert fingerprint(other) == fingerprint(flight)


@pytest.mark.parametrize("scale", ["sighting", "track", "stamp", "noise", "truth", "prior"])
def test_any_real_change_changes_it(flight, scale):
    seen, uv_px = flight.observations, flight.observations.uv_px.copy()
    uv_px[7, 1] += 0.01
    ids, stamps = seen.track_id.copy(), flight.frames_t_ns.copy()
    ids[3] += 1
    stamps[-1] += 1
    changed = {
        "sighting": {"observations": Observations(seen.frame, seen.track_id, uv_px)},
        "track": {"observations": Observations(seen.frame, ids, seen.uv_px)},
        "stamp": {"frames_t_ns": stamps},
        "noise": {"noise": replace(flight.noise, gyro_random_walk=1.001 * flight.noise.gyro_random_walk)},
        "truth": {"truth": None},
        "prior": {"prior": replace(flight.prior, cov=1.001 * flight.prior.cov)},
    }[scale]
    assert fingerprint(replace(flight, **changed)) != fingerprint(flight)
