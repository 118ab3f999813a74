"""The prediction along twists, as ``motion.predicted`` has it, by the compiled kernel; imported only where it runs."""

from collections.abc import Callable

import numpy as np

from filters.kalman.kernels import twists as kernel
from toolkit.measured_motion import Motion, TwistMotion, TwistNoise
from toolkit.models.state import Belief

COMPILED = kernel.COMPILED
_EVEN_NOISE = np.empty((0, 2))


def prediction(noise: TwistNoise) -> Callable[[Belief, Motion], Belief]:
    """Return what carries the belief of pose and gyro bias over twists of some noise."""
    densities = np.concatenate([noise.gyro_noise_density, noise.velocity_noise_density, noise.gyro_random_walk]) ** 2

    def predicted(belief: Belief, motion: Motion) -> Belief:
        assert isinstance(motion, TwistMotion)
        scale = _EVEN_NOISE if motion.noise_scale is None else np.array(motion.noise_scale)
        twists = np.array(motion.dt_s), np.array(motion.w_radps), np.array(motion.v_mps), scale
        cov = np.array(belief.cov, order="C")
        T_world_imu, cov = kernel.predict(
            twists, densities, (np.array(belief.T_world_imu[None], order="C"), np.array(belief.bias[3:]), cov)
        )
        return Belief(belief.layout, T_world_imu[0], belief.v_world, belief.bias, cov)

    return predicted
