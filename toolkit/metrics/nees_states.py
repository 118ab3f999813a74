"""Normalised estimation error squared of velocity and biases.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. A filter
may be consistent in its pose and not in its biases; the error shows in the pose much later.
"""

from collections.abc import Callable

from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import stated_errors
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate
from toolkit.metrics.parts.state_errors import NO_SUCH_BLOCK, bias_errors, layout_of, velocity_errors
from toolkit.models.gating import mahalanobis_squared

ORDER = 76
METRICS = tuple(
    Metric(
        f"nees_{key}_mean",
        f"mean normalised error squared of the {block} over its 3 degrees of freedom; 1 is consistent",
        "1",
        ("NEES", heading),
        best="one",
    )
    for key, block, heading in (
        ("vel", "velocity", "vel"),
        ("gyro_bias", "gyro bias", "gyro b"),
        ("accel_bias", "accelerometer bias", "acc b"),
    )
)


def score(evaluation: Evaluation) -> Scores:
    """Score the stated covariances of velocity and biases against the truth."""
    stated = stated_errors(evaluation)
    layout = layout_of(stated)

    def mean(block: slice | None, errors: Callable[[], Array]) -> float:
        if block is None:
            raise Unavailable(NO_SUCH_BLOCK)
        return float(mahalanobis_squared(errors(), stated.cov[:, block, block]).mean()) / 3.0

    return evaluate(
        {
            "nees_vel_mean": lambda: mean(layout.velocity, lambda: velocity_errors(evaluation, stated)),
            "nees_gyro_bias_mean": lambda: mean(layout.gyro_bias, lambda: bias_errors(evaluation, stated)[:, 3:]),
            "nees_accel_bias_mean": lambda: mean(layout.accel_bias, lambda: bias_errors(evaluation, stated)[:, :3]),
        }
    )
