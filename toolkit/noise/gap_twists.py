"""The motion where frames have no track in common: the measured twist, improved by what vision saw before and after.

Across such a gap only the measured twist connects the poses, and its error in heading turns all later poses. A car's
twist changes more slowly than measurements with noise suggest: between neighbouring intervals it is constant except for
white noise on its change (Barfoot, "State estimation for robotics" (2017), section 3.4). So in a gap the twists that
the tracks show in the nearest intervals, interpolated, measure the twist as well, with the variance of the change; the
recording is given the mean of both, weighted by their variances. Everywhere else the tracks determine the motion
better.
"""

from dataclasses import replace

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import NS_PER_S, TwistMotion, TwistNoise
from toolkit.models.camera_motion import camera_motion, neighbours
from toolkit.motion_samples import GapTwists, TwistSamples, motions_between
from toolkit.sequence import Sequence

# With fewer changes of the twist between neighbouring intervals that vision saw, their variance is not known.
_FEWEST_CHANGES = 10
# Larger changes are clipped to this many standard deviations: they are failures of vision, not motion.
_MOST_SIGMAS = 3.0
_ROUNDS = 5
# Least variance of a prediction, as a share of the measured twist's: a twist that never changed in what vision saw
# would leave none, and a motion without noise has a singular covariance.
_LEAST_VARIANCE = 1e-4


@np.errstate(all="ignore")  # wild values overflow, and say nothing of a twist
def with_gap_twists(sequence: Sequence) -> Sequence:
    """Return a recording with measured twists improved in the intervals that no visible track leads across.

    It is the recording itself where there are none, where vision does not say how much twists change, or where nothing
    or no twist was measured. What was improved is recorded in the facts.
    """
    motion, noise = sequence.motion, sequence.noise
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)) or sequence.frame_count < 3:
        return sequence
    visible = sequence.visible
    common = np.bincount(neighbours(visible).interval, minlength=sequence.frame_count - 1)
    if not len(visible) or common.all():
        return sequence
    found = _improved(sequence, common == 0, noise)
    if found is None:
        return sequence
    fact = (
        f"in {len(found.begin_t_ns)} intervals no track leads from one frame to the next; there the measured twist is "
        "improved by what vision saw before and after (noise.bridge_gaps)"
    )
    return replace(sequence, gap_twists=found).with_facts(fact)


def _improved(sequence: Sequence, gaps: BoolArray, noise: TwistNoise) -> GapTwists | None:
    t_ns, dt_s = sequence.frames_t_ns, np.diff(sequence.frames_t_ns) / NS_PER_S
    moved = camera_motion(replace(sequence, observations=sequence.visible, track_budget=None))
    seen = moved.of_imu(sequence.rig.T_imu_cam)
    known = moved.known & ~gaps
    changes_per_s = _change_variance(seen, known, dt_s)
    if changes_per_s is None:
        return None
    pieces = (one for one in motions_between(sequence.motion, t_ns, sequence.bridges) if isinstance(one, TwistMotion))
    measured = np.array([np.average(np.hstack([m.w_radps, m.v_mps]), axis=0, weights=m.dt_s) for m in pieces])
    # The gyro's bias stays in the measurement, where estimators look for it.
    seen[:, :3] += np.median((measured - seen)[known, :3], axis=0)
    middle_s, here, at = sequence.frames_s[:-1] + 0.5 * dt_s, np.flatnonzero(gaps), np.flatnonzero(known)
    predicted = np.stack([np.interp(middle_s[here], middle_s[at], column) for column in seen[at].T], axis=1)
    stated = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density]) ** 2 / dt_s[here, None]
    variance = np.maximum(changes_per_s * _distance_s(middle_s, here, at)[:, None], _LEAST_VARIANCE * stated)
    weight = stated / (stated + variance)
    mean = measured[here] + weight * (predicted - measured[here])
    scale = np.sqrt((1.0 - weight).reshape(-1, 2, 3).mean(axis=2))[:, ::-1]
    return GapTwists(t_ns[here], t_ns[here + 1], mean[:, 3:], mean[:, :3], scale)


def _change_variance(seen: Array, known: BoolArray, dt_s: Array) -> Array | None:
    """Return the variance (6,) per second of the twist's change between neighbouring intervals that vision saw.

    It contains the noise of vision, so that it is rather too large.
    """
    both = known[1:] & known[:-1]
    if both.sum() < _FEWEST_CHANGES:
        return None
    squares = np.square(np.diff(seen, axis=0)[both]) / (0.5 * (dt_s[1:] + dt_s[:-1]))[both, None]
    mean = squares.mean(axis=0)
    for _ in range(_ROUNDS):
        mean = np.minimum(squares, _MOST_SIGMAS**2 * mean).mean(axis=0)
    return np.asarray(mean)


def _distance_s(middle_s: Array, gaps: IntArray, known: IntArray) -> Array:
    """Return for how long (G,) s a random walk goes on from the known intervals around, given both of its ends."""
    after = np.searchsorted(known, gaps)
    before_s = np.where(after > 0, middle_s[gaps] - middle_s[known[np.maximum(after - 1, 0)]], np.inf)
    after_s = np.where(after < known.size, middle_s[known[np.minimum(after, known.size - 1)]] - middle_s[gaps], np.inf)
    return np.asarray(1.0 / (1.0 / before_s + 1.0 / after_s))
