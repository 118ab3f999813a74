"""The scale of all disparities as a variable of a smoother's graph: its prior, its covariance, its log line.

The tracks alone do not observe it: a change of scale scales the whole world, path and landmarks. Measured motion does
observe it, so the scale absorbs the overall disagreement between vision and motion samples. Only its prior says which
of the two is more likely to be wrong.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from filters.smoothing.indeterminate import no_covariances
from toolkit.estimate import Trajectory
from toolkit.models.factors import SCALE
from toolkit.models.motion import MotionModel
from toolkit.models.state_covariances import covs_beside

# With a standard deviation above this share of the prior's, the measurements do not determine the scale.
_UNDETERMINED = 0.95


@dataclass(frozen=True)
class ScaleState:
    """The scale of disparities, 0 with a prior standard deviation."""

    prior_sigma: float

    def add_to(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Add the variable, at 0, and its prior."""
        values.insert(SCALE, np.zeros(1))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, self.prior_sigma)
        graph.add(gtsam.PriorFactorVector(SCALE, np.zeros(1), noise))

    def with_covariances(
        self,
        trajectory: Trajectory,
        linear: gtsam.GaussianFactorGraph,
        motion: MotionModel,
        scale: float,
    ) -> tuple[Trajectory, tuple[str, ...]]:
        """Return the trajectory with the covariance of every state and a line about the scale; or why there is none.

        The covariances include the uncertainty of the scale.
        """
        try:
            covs, of_scale = covs_beside(linear, motion, trajectory.T_world_imu, (SCALE,))
        except RuntimeError as refusal:
            return trajectory, (f"disparities are {100.0 * scale:+.2f} % longer", no_covariances(refusal))
        return replace(trajectory, cov=covs), (self.message_of(scale, float(np.sqrt(of_scale[0, 0]))),)

    def message_of(self, scale: float, sigma: float) -> str:
        """Return the log line about the scale."""
        message = f"disparities are {100.0 * scale:+.2f} +- {100.0 * sigma:.2f} % longer than the rig's"
        if sigma > _UNDETERMINED * self.prior_sigma:
            return f"{message}: the measurements do not determine it, and that is the prior"
        return f"{message} (prior 0 +- {100.0 * self.prior_sigma:g} %)"
