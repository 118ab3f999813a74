"""Keeping some of the motion samples, of either kind."""

from dataclasses import replace

from toolkit.geometry import BoolArray, IntArray
from toolkit.sequence import MotionSamples, Sequence, TwistSamples


def keep_samples(sequence: Sequence, kept: BoolArray | IntArray) -> Sequence:
    """Return the sequence with the motion samples of a mask (S,) or an index (M,), in that order."""
    motion = sequence.motion
    t_ns = motion.t_ns[kept]
    samples: MotionSamples
    if isinstance(motion, TwistSamples):
        samples = replace(motion, t_ns=t_ns, v_mps=motion.v_mps[kept], w_radps=motion.w_radps[kept])
    else:
        samples = replace(motion, t_ns=t_ns, accel_mps2=motion.accel_mps2[kept], gyro_radps=motion.gyro_radps[kept])
    return replace(sequence, motion=samples)
