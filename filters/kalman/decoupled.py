"""What a frame of the decoupled filter is made of, compiled where that is asked for and possible: NumPy defines it."""

from collections.abc import Callable
from typing import NamedTuple

from filters.kalman import correction, landmark_map
from filters.kalman.correction import FrameCorrection
from filters.kalman.gate import FrameGate
from filters.kalman.landmark_map import LandmarkMap
from toolkit.compilation import Compilation
from toolkit.geometry import Array
from toolkit.measured_motion import Motion, MotionNoise, TwistNoise
from toolkit.models.motion import MotionModel, predicted
from toolkit.models.state import Belief
from toolkit.sequence import StereoRig


class Steps(NamedTuple):
    """What carries a belief over a motion, corrects it and N landmarks by sightings (N, 3) px, and starts landmarks."""

    predict: Callable[[Belief, Motion], Belief]
    correct: Callable[[Belief, LandmarkMap, Array, StereoRig, FrameGate], FrameCorrection]
    start: Callable[[Array, Array, StereoRig], tuple[Array, Array]]


def steps(model: MotionModel, noise: MotionNoise, compilation: Compilation) -> Steps:
    """Return the steps of a filter whose motion has a model of some noise; other motion than twists is left to it."""
    numpy = Steps(lambda belief, motion: predicted(belief, model, motion), correction.corrected, landmark_map.started)
    compiled = compilation.module("filters.kalman.compiled_correction")
    if compiled is None:
        return numpy
    found = numpy._replace(correct=compiled.corrected, start=compiled.started)
    twists = compilation.module("filters.kalman.compiled_twists") if isinstance(noise, TwistNoise) else None
    return found if twists is None else found._replace(predict=twists.prediction(noise))
