"""The motion model of a recording, by the kind of its measurements.

They are in :mod:`toolkit.models.twist` (also where nothing was measured) and :mod:`toolkit.models.imu`. What they offer
filters is in :mod:`toolkit.models.state`, and what they offer graphs in :mod:`toolkit.models.graph_state`.
"""

from toolkit.geometry import Array
from toolkit.measurements import MotionNoise, TwistChangeNoise, TwistNoise
from toolkit.models.graph_state import MotionModel
from toolkit.models.imu import ImuModel
from toolkit.models.state import predicted
from toolkit.models.twist import SmoothTwist, TwistModel

# Estimators of users import `predicted` from here.
__all__ = ["motion_model", "predicted"]


def motion_model(noise: MotionNoise, gravity_world: Array) -> MotionModel:
    """Return the model for the kind of motion whose noise this is; ``gravity_world`` (3,) m/s^2."""
    if isinstance(noise, TwistNoise):
        return TwistModel(noise)
    if isinstance(noise, TwistChangeNoise):
        return SmoothTwist(noise)
    return ImuModel(noise, gravity_world)
