"""How well the stated distribution of the pose fits its errors: coverage of regions, log score and energy score.

NEES asks whether errors are as large as stated. A proper score asks for the whole distribution: it is least, on
average, for the one that errors come from, so neither a larger covariance nor a smaller one helps (Gneiting & Raftery,
"Strictly proper scoring rules, prediction, and estimation", JASA 2007, sections 4.1 and 4.3). Errors and covariances
are those of the NEES, in the tangent space of the estimate.
"""

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import UNCOUPLED, StatedErrors, nees_of, stated_errors
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores
from toolkit.models.gating import chi2_bound

ORDER = 76
GROUP = "uncertainty"
REGIONS_PERCENT = (50, 90, 95)
_BLOCKS = {"pose": ("the pose", 6), "ori": ("the orientation", 3), "pos": ("the position", 3)}
_SHORT = {"pose": "pose", "ori": "rot", "pos": "pos"}
# Nodes of the quadrature: exact to 1e-12, and to some 1e-9 where standard deviations differ a thousandfold.
_NODES = 96
METRICS = (
    *(
        Metric(
            f"inside_{percent}_{block}_percent",
            f"errors of {what} inside the region that is stated to hold {percent} % of them (percent)",
            "%",
            (f"in {percent} %", _SHORT[block]),
            best="",
        )
        for block, (what, _) in _BLOCKS.items()
        for percent in REGIONS_PERCENT
    ),
    *(
        Metric(
            f"log_score_{block}",
            f"mean of -log of the stated density of {what} at the truth (nat; rad and m)",
            "1",
            ("log score", _SHORT[block]),
        )
        for block, (what, _) in _BLOCKS.items()
    ),
    Metric("energy_ori_deg", "mean energy score of the orientation's rotation vector", "deg", ("energy", "rot")),
    Metric("energy_pos_m", "mean energy score of the position", "m", ("energy", "pos")),
)


def score(evaluation: Evaluation) -> Scores:
    return of_stated(stated_errors(evaluation))


def of_stated(stated: StatedErrors) -> Scores:
    """Score the distributions of some errors; those of the pose have no value where its blocks are stated apart."""
    nees = nees_of(stated)
    found: dict[str, float | None] = {metric.key: None for metric in METRICS}
    for block, (_, dof) in _BLOCKS.items():
        rows = slice(0, 3) if block == "ori" else slice(3, 6) if block == "pos" else slice(0, 6)
        squared = dof * {"pose": nees.pose, "ori": nees.orientation, "pos": nees.position}[block]
        for percent in REGIONS_PERCENT:
            inside = squared <= chi2_bound(dof, percent / 100.0)
            found[f"inside_{percent}_{block}_percent"] = 100.0 * float(inside.mean())
        covs = stated.cov[:, rows, rows]
        log_det = np.linalg.slogdet(covs)[1] if np.isfinite(squared).all() else np.nan
        found[f"log_score_{block}"] = float(np.mean(0.5 * (squared + log_det + dof * np.log(2.0 * np.pi))))
        if block == "ori":
            found["energy_ori_deg"] = float(np.degrees(energy_scores(nees.errors[:, rows], covs).mean()))
        elif block == "pos":
            found["energy_pos_m"] = float(energy_scores(nees.errors[:, rows], covs).mean())
    return Scores(found).without(() if nees.is_coupled else [key for key in found if "_pose" in key], UNCOUPLED)


def energy_scores(errors: Array, covs: Array) -> Array:
    """Return E|X - e| - E|X - X'| / 2 (n,) of errors (n, d), X and X' as stated (Gneiting & Raftery 2007, eq. 22)."""
    variances, axes = np.linalg.eigh(covs)
    along = np.einsum("nij,ni->nj", axes, errors)
    return _mean_length(along, variances) - 0.5 * _mean_length(np.zeros_like(along), 2.0 * variances)


def _mean_length(means: Array, variances: Array) -> Array:
    """Return E|x| (n,) of normal x with independent entries of means (n, d) and variances (n, d).

    Of a squared length Q with E exp(-tQ) = M(t) it is the integral of (1 - M(t)) t^(-3/2) / (2 sqrt(pi)), and with
    t = tan(a)^2 / EQ a smooth one over a quarter of a turn.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    angles, weights = 0.25 * np.pi * (nodes + 1.0), 0.25 * np.pi * weights
    mean_square = (means**2 + variances).sum(axis=-1)[:, None]
    t = (np.tan(angles) ** 2 / mean_square)[..., None]  # (n, nodes, 1)
    widened = 1.0 + 2.0 * t * variances[:, None]
    moments = np.exp(-(t * means[:, None] ** 2 / widened).sum(axis=-1)) / np.sqrt(widened.prod(axis=-1))
    integrals: Array = ((1.0 - moments) / np.sin(angles) ** 2) @ weights
    return np.asarray(np.sqrt(mean_square[:, 0] / np.pi) * integrals)
