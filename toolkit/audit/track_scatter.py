"""Tracks that scatter more than the stated noise of a sighting explains: mismatches, or a noise that is too small.

About the camera's own best motion a point triangulated in one frame, of noise R, and projected into the next misses its
sighting there by J R J^T + R, whatever the motion samples say. The upper quartile of that distance is chi-square's with
three degrees of freedom where R is right; the few grossest do not move it. Every estimator is told R and trusts it.

Where a real tracker's noise is assumed, and less than that, mismatches hide beneath it: those are told by their size.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error
from toolkit.models.gating import mahalanobis_squared

# Standard deviations over the stated ones. 21 sound simulated recordings have 0.98 to 1.00 and real ones, whose noise
# is assumed, at most 0.62; a tenth of mismatches makes 1.04 to 1.07, three tenths 1.20 to 1.46.
MOST_SCATTER, SIGMAS = 1.05, 5.0
# Distances that a quarter of the sightings exceed, and one in a thousand.
UPPER_QUARTILE, FAR_CHI2 = 4.108, 16.27
# Beyond this, 32 standard deviations, a sighting is of another point. Sound real recordings have 0.6 % of them at most,
# of moving objects and repeated frames; the limit was chosen with them in view.
GROSS_CHI2, MOST_GROSS = 1000.0, 0.02
# Where the nearer half is as the stated noise has it, or a fifth of mismatches makes it, so is the tail, but for
# mismatches: a tenth of tracks that slide makes 2.1 to 5.6 % of far distances, sound simulations 0.06 to 0.12 %.
MEDIAN_CHI2, USUAL_SCATTER = 2.366, (0.95, 1.12)
MOST_FAR, FAR_SIGMAS = 0.008, 3.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Hold the scatter of the tracks about the camera's own motion against the stated noise."""
    sequence = evidence.sequence
    if evidence.spoilt_by or evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return evidence.blind
    steps = evidence.one_step
    chi2 = mahalanobis_squared(steps.residual_px, steps.cov_px2)
    scatter, error = _scatter(chi2), jackknife_error(_scatter, chi2)
    if not np.isfinite(scatter):
        return evidence.blind
    if scatter < MOST_SCATTER + SIGMAS * error:
        return _tail(chi2)
    sigma_px = " ".join(f"{sigma:.2g}" for sigma in np.sqrt(np.diag(sequence.rig.cov_uv_px2)))
    return Symptom(
        count=1,
        detail=(
            f"from frame to frame the tracks scatter {scatter:.2f} +- {error:.2f} times as much as the stated noise of "
            f"a sighting explains (uL uR v: {sigma_px} px); {np.mean(chi2 > FAR_CHI2):.0%} are beyond chance"
        ),
        treatment="mismatches, points that move, or noise stated too small: estimators trust such tracks too much",
        remedy=None,
        harmful=False,
        warns=True,
    )


def _tail(chi2: Array) -> Symptom | None:
    """Tell of gross distances (P,), or of far ones beyond chance where the nearer half is as the noise has it."""
    gross, error = _gross_share(chi2), jackknife_error(_gross_share, chi2)
    if gross > MOST_GROSS + SIGMAS * error:
        return _mismatched(f"{gross:.1%} +- {error:.1%}", f"{np.sqrt(GROSS_CHI2):.0f} times what the noise explains")
    far, error = _far_share(chi2), jackknife_error(_far_share, chi2)
    least, most = USUAL_SCATTER
    if least < np.sqrt(np.median(chi2) / MEDIAN_CHI2) < most and far > MOST_FAR + FAR_SIGMAS * error:
        return _mismatched(f"{far:.1%} +- {error:.1%}", "the stated noise explains (0.1% do by chance)")
    return None


def _mismatched(share: str, than: str) -> Symptom:
    return Symptom(
        count=1,
        detail=f"from frame to frame {share} of the sightings miss by more than {than}",
        treatment="mismatches, exchanged ids, or points that move: estimators must refuse as many",
        remedy=None,
        harmful=False,
        warns=True,
    )


def _scatter(chi2: Array) -> float:
    """Return the standard deviation over the stated one that the upper quartile of squared distances (P,) shows."""
    return float(np.sqrt(np.quantile(chi2, 0.75) / UPPER_QUARTILE))


def _gross_share(chi2: Array) -> float:
    return float(np.mean(chi2 > GROSS_CHI2))


def _far_share(chi2: Array) -> float:
    return float(np.mean(chi2 > FAR_CHI2))


FAULT = Fault(
    "track-scatter",
    "tracks that scatter more than the stated noise explains: mismatches, or a noise that is too small",
    check,
    after=("swapped-coordinates", "no-disparity", "stale-frames", "doubled-disparity", "intrinsics", "units"),
)
