"""How probable a track noise makes the residuals of all tracks, with its gradient.

The landmark of each track is eliminated with a flat prior (restricted likelihood: Patterson & Thompson 1971), and what
is left is multivariate Student-t: a track that slid off its point, or whose point moves, counts little (Lange, Little &
Taylor, "Robust statistical modeling using the t distribution", 1989).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, psi

from toolkit.geometry import Array
from toolkit.track_errors.linearised import Linearised
from toolkit.track_noise import TrackNoise


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals (3, B, n) px of B tracks, channel by channel, and their derivatives by the landmark (3, B, 3, n)."""

    px: Array
    by_landmark: Array

    @classmethod
    def of(cls, tracks: Linearised, freedom: float) -> "Residuals":
        """Return those about adjusted poses, as large as errors are where the poses left that share of freedom."""
        px = np.moveaxis(tracks.residual_px, 2, 0) / np.sqrt(freedom)
        by_landmark = tracks.d_landmark.transpose(2, 0, 3, 1)
        return cls(np.ascontiguousarray(px), np.ascontiguousarray(by_landmark))

    def select(self, rows: slice) -> "Residuals":
        """Return those of some tracks."""
        return Residuals(self.px[:, rows], self.by_landmark[:, rows])

    @property
    def equations(self) -> int:
        """Return how many equations (3 n - 3) a track has, the landmark eliminated."""
        return 3 * int(self.px.shape[2]) - 3


@dataclass(frozen=True, eq=False)
class Tailed:
    """The noise of most tracks, and the degrees of freedom of the Student-t: the fewer, the heavier its tails."""

    noise: TrackNoise
    degrees: float

    def weights(self, chi2: Array, equations: int) -> Array:
        """Return what tracks (B,) count, by their squared whitened residuals: about 1 for most, less for outliers."""
        return np.asarray((self.degrees + equations) / (self.degrees + chi2))


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Log-likelihood (B,) of each track, and the gradients of their sum.

    ``by_variance`` (3, 3) is that by the variances, white, walk, offset x c, d, v; ``by_degrees`` that by the degrees
    of freedom. ``chi2`` (B,) is the squared whitened residual of each track, its landmark at its best.
    """

    each: Array
    by_variance: Array
    by_degrees: float
    chi2: Array


def likelihood(tracks: Residuals, model: Tailed) -> Likelihood:
    """Return the likelihood of tracks of one length."""
    n = tracks.px.shape[2]
    cov = model.noise.cov(np.arange(float(n)))
    information = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    weighted = tracks.px @ information
    weighted_by = (tracks.by_landmark.reshape(3, -1, n) @ information).reshape(tracks.by_landmark.shape)
    normal: Array = (weighted_by @ np.swapaxes(tracks.by_landmark, 2, 3)).sum(axis=0)  # (B, 3, 3)
    root = np.linalg.cholesky(normal)
    spread: Array = np.linalg.solve(root[None], weighted_by)  # C^-1 H R^-1, transposed
    explained = (spread @ tracks.px[..., None]).sum(axis=0)  # (B, 3, 1)
    left = weighted - (np.swapaxes(spread, 2, 3) @ explained)[..., 0]  # P r
    chi2 = np.maximum((left * tracks.px).sum(axis=(0, 2)), 0.0)
    log_det = np.linalg.slogdet(cov)[1].sum() + 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    each, by_degrees = _student(chi2, tracks.equations, model.degrees)
    by_variance = _by_variance(information, left, spread, model.weights(chi2, tracks.equations))
    return Likelihood(each - 0.5 * log_det, by_variance, by_degrees, chi2)


def _student(chi2: Array, p: int, nu: float) -> tuple[Array, float]:
    """Return the log-density (B,) of a whitened p-dimensional Student-t, and the sum of its derivative by nu."""
    constant = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(np.pi * nu)
    tail = np.log1p(chi2 / nu)
    slope = psi(0.5 * (nu + p)) - psi(0.5 * nu) - p / nu - tail + (nu + p) * chi2 / (nu * (nu + chi2))
    return constant - 0.5 * (nu + p) * tail, 0.5 * float(slope.sum())


def _by_variance(information: Array, left: Array, spread: Array, weight: Array) -> Array:
    """Return half of the weighted r^T P K P r - tr(P K) (3, 3), K the parts of each channel's covariance."""
    count, n = left.shape[1:]
    ages = np.arange(n)
    rows = []
    for part in (np.eye(n), np.minimum(ages[:, None], ages), np.ones((n, n))):
        fitted = ((left @ part) * left).sum(axis=2) @ weight
        explained = ((spread.reshape(3, -1, n) @ part) * spread.reshape(3, -1, n)).sum(axis=(1, 2))
        rows.append(fitted - count * (information * part).sum(axis=(1, 2)) + explained)
    return 0.5 * np.stack(rows)


def joined(parts: Iterable[Likelihood]) -> Likelihood:
    """Return the likelihood of all tracks, group after group."""
    parts = list(parts)
    each, chi2 = (np.concatenate([getattr(part, name) for part in parts]) for name in ("each", "chi2"))
    by_variance = np.sum([part.by_variance for part in parts], axis=0)
    return Likelihood(each, by_variance, sum(part.by_degrees for part in parts), chi2)
