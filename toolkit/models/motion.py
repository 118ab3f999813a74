"""The motion model of a recording, by the kind of its measurements.

They are in :mod:`toolkit.models.twist` (also where nothing was measured) and :mod:`toolkit.models.imu`. What they offer
filters and smoothers is in :mod:`toolkit.models.state`.
"""

from toolkit.geometry import Array
from toolkit.measurements import Motion, MotionNoise, TwistChangeNoise, TwistNoise
from toolkit.models.imu import ImuModel
from toolkit.models.state import Belief, MotionModel
from toolkit.models.twist import SmoothTwist, TwistModel


def motion_model(noise: MotionNoise, gravity_world: Array) -> MotionModel:
    """Return the model for the kind of motion whose noise this is; ``gravity_world`` (3,) m/s^2."""
    if isinstance(noise, TwistNoise):
        return TwistModel(noise)
    if isinstance(noise, TwistChangeNoise):
        return SmoothTwist(noise)
    return ImuModel(noise, gravity_world)


def predicted(belief: Belief, model: MotionModel, motion: Motion | None) -> Belief:
    """Return the belief predicted over a measured motion; unchanged if there is none, at the first frame."""
    if motion is None:
        return belief
    return belief.predicted(model.integrate(motion, belief.bias).predict(belief))
