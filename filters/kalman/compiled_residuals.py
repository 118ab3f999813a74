"""What a correlation of residuals learns of tracks, by the compiled kernel; imported only where that runs."""

from filters.kalman.compiled_gate import camera_of, given
from filters.kalman.kernels import residuals as kernel
from filters.kalman.multiview import TrackSightings
from filters.kalman.residual_correlation import FEWEST_SIGHTINGS, ResidualCorrelation
from toolkit.geometry import Array
from toolkit.sequence import StereoRig

COMPILED = kernel.COMPILED


def learn(
    correlation: ResidualCorrelation, sightings: TrackSightings, points: Array, poses: Array, rig: StereoRig
) -> None:
    """Take in tracks as ``ResidualCorrelation.learn`` does, compiled where no right image is missing."""
    if not correlation.matches:
        return
    if sightings.left_only.any():
        correlation.learn(sightings, points, poses)
        return
    arrays, (points, poses) = given((sightings.uvs_px, sightings.seen)), given((points, poses))
    correlation.add(*kernel.successive_residuals(arrays, points, poses, camera_of(rig), FEWEST_SIGHTINGS))
