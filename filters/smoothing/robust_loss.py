"""Losses of the norms of whitened residuals, vectorised, by the formulas of GTSAM's robust losses."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from toolkit.geometry import Array


class Loss(Protocol):
    """The costs of residuals with given norms (N,), and the weights of their squares."""

    def cost(self, norms: Array) -> Array:
        """Return the costs (N,)."""

    def weight(self, norms: Array) -> Array:
        """Return the weights (N,) in (0, 1]: the slope of the cost over the length."""


class Squares:
    """No loss: half the square."""

    def cost(self, norms: Array) -> Array:
        """Return the costs (N,)."""
        return np.asarray(0.5 * np.square(norms))

    def weight(self, norms: Array) -> Array:
        """Return ones (N,)."""
        return np.ones_like(norms)


@dataclass(frozen=True)
class Huber:
    """Linear beyond a threshold."""

    threshold: float

    def cost(self, norms: Array) -> Array:
        """Return the costs (N,)."""
        linear = self.threshold * (norms - 0.5 * self.threshold)
        return np.where(norms <= self.threshold, 0.5 * np.square(norms), linear)

    def weight(self, norms: Array) -> Array:
        """Return the weights (N,)."""
        return np.asarray(self.threshold / np.maximum(norms, self.threshold))


@dataclass(frozen=True)
class Cauchy:
    """Grows logarithmically beyond a scale, so that the weight of large residuals vanishes."""

    scale: float

    def cost(self, norms: Array) -> Array:
        """Return the costs (N,)."""
        return np.asarray(0.5 * self.scale**2 * np.log1p(np.square(norms / self.scale)))

    def weight(self, norms: Array) -> Array:
        """Return the weights (N,)."""
        return np.asarray(1.0 / (1.0 + np.square(norms / self.scale)))
