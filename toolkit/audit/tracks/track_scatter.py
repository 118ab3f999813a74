"""Tracks whose scatter contradicts the stated noise of a sighting: mismatches, or a wrong stated noise.

A point triangulated in one frame, moved by the camera's own best motion and projected into the next, has a residual of
covariance J R J^T + R there, where R is the covariance of a sighting. The motion samples are not used. If R is right,
the squared Mahalanobis distances have the upper quartile of the chi-square distribution with three degrees of freedom,
which a few gross errors do not change. Every estimator uses R.

Where R is assumed and a real tracker is more accurate, mismatches do not raise the upper quartile. They are found by
their number of gross residuals.

A scatter far below the stated noise contradicts it too, unless errors are correlated from frame to frame, because an
error that lasts along a track is not in its steps. If the errors are independent (``correlated_tracks``), the
conclusion is certain.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.one_step import errors_are_independent
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error
from toolkit.models.gating import CHI2_3_MEDIAN, mahalanobis_squared
from toolkit.models.noise import TRACKED_PIXEL_SIGMA_PX

# Limit of the ratio of the standard deviation to the stated one. 21 sound simulated recordings have 0.98 to 1.00 and
# real ones, whose noise is assumed, at most 0.62. A tenth of mismatches gives 1.04 to 1.07, three tenths 1.20 to 1.46.
MOST_SCATTER, SIGMAS = 1.05, 5.0
# Squared distances that a quarter of the sightings exceed, and one in a thousand (chi-square, 3 degrees of freedom).
UPPER_QUARTILE, FAR_CHI2 = 4.108, 16.27
# Beyond this squared distance, 32 standard deviations, a sighting is of another point. Sound real recordings have at
# most 0.6 % of these, on moving objects and in repeated frames; the limit of their share was chosen with them in view.
GROSS_CHI2, MOST_GROSS = 1000.0, 0.02
# Ratios of the squared distances' median to its expectation that agree with the stated noise, also with a fifth of
# mismatches. The tail must then agree as well, unless there are mismatches: a tenth of sliding tracks gives 2.1 to 5.6
# % of far distances, sound simulations have 0.06 to 0.12 %.
USUAL_SCATTER = (0.95, 1.12)
MOST_FAR, FAR_SIGMAS = 0.008, 3.0
# Independent errors contradict a noise that is stated this many times too large. With few tracks the scatter is a
# little too small, because the camera's motion is fitted to them; and a noise overstated on purpose is often less than
# that.
MOST_OVERSTATED = 1.5
# The same limit for correlated errors, whose steps scatter less than the errors. The noise stated of the toolkit's own
# tracker is 7 times the scatter of its steps on EuRoC's images, and so is that of simulated tracks like it. Chosen with
# these in view.
MOST_OVERSTATED_CORRELATED = 10.0
# Ratio of standard deviations below which tracks are exact, as in a simulation without noise.
_NO_ERROR = 1e-5
# If the stated noise alone is wrong, the ratios by the median and by the upper quartile agree to within these factors.
SAME_RATIO = (0.9, 1.1)


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the scatter of the tracks about the camera's own motion with the stated noise."""
    if evidence.spoilt_by or evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return evidence.blind
    steps = evidence.one_step
    chi2 = mahalanobis_squared(steps.residual_px, steps.cov_px2)
    scatter, error = _scatter(chi2), jackknife_error(_scatter, chi2)
    if not np.isfinite(scatter):
        return evidence.blind
    if scatter < MOST_SCATTER + SIGMAS * error:
        return _tail(chi2) or _overstated(evidence, scatter, error)
    cause = "mismatches, points that move, or noise stated too small"
    if SAME_RATIO[0] < _nearer_scatter(chi2) / scatter < SAME_RATIO[1]:
        cause = f"near and far ones equally, so the noise is stated {scatter:.3g} times too small"
    return _symptom(
        f"{_scatters(evidence, scatter, error)}; {np.mean(chi2 > FAR_CHI2):.0%} are beyond chance",
        f"{cause}: estimators give such tracks too much weight",
    )


def _overstated(evidence: Evidence, scatter: float, error: float) -> Symptom | None:
    """Report tracks that scatter far less than the stated noise, and whether that noise alone explains it.

    Six parameters of the camera's motion are fitted to the 3 n residuals of an interval, which lowers their scatter.
    """
    _, interval, pairs = np.unique(
        evidence.sequence.observations.frame[evidence.one_step.after], return_inverse=True, return_counts=True
    )
    left = float(np.mean(np.maximum(1.0 - 2.0 / pairs, 0.0)[interval]))
    correlation = evidence.step_correlation
    if left <= 0.0 or scatter < _NO_ERROR or correlation is None:
        return None
    scatter, error = scatter / np.sqrt(left), error / np.sqrt(left)
    independent = errors_are_independent(correlation)
    least = 1.0 / (MOST_OVERSTATED if independent else MOST_OVERSTATED_CORRELATED)
    if scatter + SIGMAS * error > least:
        return None
    times = f"{1.0 / scatter:.2g}" if scatter > 0.1 else f"{1.0 / scatter:.0f}"
    cause = f"the noise is stated {times} times too large, or the errors are constant along tracks"
    if not independent:
        cause = f"the noise is stated too large, by less than {times} times as the errors are correlated between frames"
    symptom = _symptom(_scatters(evidence, scatter, error), f"{cause}: estimators give such tracks too little weight")
    if np.sqrt(evidence.sequence.rig.cov_uv_px2[0, 0]) != TRACKED_PIXEL_SIGMA_PX:
        return symptom
    # This noise was not stated: it is the one assumed where a recording states none.
    assumed = f"{symptom.treatment}; half a pixel is assumed where nothing is stated, and noise.pixel_sigma_px sets it"
    return replace(symptom, treatment=assumed, warns=False)


def _scatters(evidence: Evidence, scatter: float, error: float) -> str:
    sigma_px = " ".join(f"{sigma:.2g}" for sigma in np.sqrt(np.diag(evidence.sequence.rig.cov_uv_px2)))
    figures = f"{scatter:.2f} +- {error:.2f}" if scatter >= 1.0 else f"{scatter:.2g} +- {error:.1g}"
    return (
        f"from frame to frame the tracks scatter {figures} times as much as the stated noise of a sighting explains "
        f"(uL uR v: {sigma_px} px)"
    )


def _symptom(detail: str, treatment: str) -> Symptom:
    return Symptom.warning(count=1, detail=detail, treatment=treatment)


def _tail(chi2: Array) -> Symptom | None:
    """Report too many gross distances (P,), or too many far ones where the median agrees with the noise."""
    gross, error = _gross_share(chi2), jackknife_error(_gross_share, chi2)
    if gross > MOST_GROSS + SIGMAS * error:
        return _mismatched(f"{gross:.1%} +- {error:.1%}", f"{np.sqrt(GROSS_CHI2):.0f} times what the noise explains")
    far, error = _far_share(chi2), jackknife_error(_far_share, chi2)
    least, most = USUAL_SCATTER
    if least < _nearer_scatter(chi2) < most and far > MOST_FAR + FAR_SIGMAS * error:
        return _mismatched(f"{far:.1%} +- {error:.1%}", "the stated noise explains (0.1% do by chance)")
    return None


def _mismatched(share: str, than: str) -> Symptom:
    return _symptom(
        f"from frame to frame {share} of the sightings have residuals of more than {than}",
        "mismatches, exchanged ids, or points that move: estimators must reject as many",
    )


def _scatter(chi2: Array) -> float:
    """Return the ratio of the standard deviation to the stated one, by the upper quartile of squared distances (P,)."""
    return float(np.sqrt(np.quantile(chi2, 0.75) / UPPER_QUARTILE))


def _nearer_scatter(chi2: Array) -> float:
    """Return the same ratio by the median of the squared distances (P,)."""
    return float(np.sqrt(np.median(chi2) / CHI2_3_MEDIAN))


def _gross_share(chi2: Array) -> float:
    return float(np.mean(chi2 > GROSS_CHI2))


def _far_share(chi2: Array) -> float:
    return float(np.mean(chi2 > FAR_CHI2))


FAULT = Fault(
    "track-scatter",
    "tracks that scatter more than the stated noise explains, or far less: mismatches, or a noise stated wrongly",
    check,
    after=("swapped-coordinates", "no-disparity", "stale-frames", "doubled-disparity", "intrinsics", "units"),
)
