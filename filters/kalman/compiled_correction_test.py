"""The test of a correction, as ``toolkit.models.corrections`` has it, by a compiled kernel; imported where it runs."""

import numpy as np

from filters.kalman.kernels import correction_test as kernel
from toolkit.geometry import Array, IntArray
from toolkit.models.corrections import LEAST_TAKEN, CorrectionTest
from toolkit.models.state import Belief, Layout

COMPILED = kernel.COMPILED


def correction_test(before: Belief, after: Belief) -> CorrectionTest:
    """Test what measurements made of a belief: ``corrections.correction_test``, compiled."""
    return CorrectionTest(*kernel.test_correction(_given(before), _given(after), _places(before.layout), LEAST_TAKEN))


def _given(belief: Belief) -> tuple[Array, Array, Array]:
    return (
        np.array(belief.T_world_imu[None], order="C"),
        np.concatenate([belief.v_world, belief.bias]),
        np.ascontiguousarray(belief.cov),
    )


def _places(layout: Layout) -> IntArray:
    """Return where velocity, accel bias and gyro bias stand, -1 for what the layout has not."""
    blocks = (layout.velocity, layout.accel_bias, layout.gyro_bias)
    return np.array([-1 if block is None else block.start for block in blocks])
