"""An evolution strategy that adapts a diagonal covariance, for searches of a few hundred evaluations.

sep-CMA-ES: Ros and Hansen, "A simple modification in CMA-ES achieving linear time and space complexity", PPSN X, 2008;
its constants are those of Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772, table 1.
"""

from __future__ import annotations

import numpy as np


class DiagonalEvolution:
    """Samples parameters, and moves towards those that score highest."""

    def __init__(self, size: int, population: int, rng: np.random.Generator, spread: float = 0.8) -> None:
        """Begin at 0.

        Args:
            size: Number of parameters, n.
            population: Samples of a generation.
            rng: Random numbers.
            spread: Standard deviation of the first samples.
        """
        self.mean, self.std, self.variance = np.zeros(size), spread, np.ones(size)
        self.population, self.rng = population, rng
        self._path_std, self._path = np.zeros(size), np.zeros(size)
        weights = np.log(population / 2 + 0.5) - np.log(np.arange(1, population // 2 + 1))
        self._weights = weights / weights.sum()
        mass = 1 / float((self._weights**2).sum())
        self._mass, n = mass, size
        self._rate_std = (mass + 2) / (n + mass + 5)
        self._damping = 1 + 2 * max(0.0, np.sqrt((mass - 1) / (n + 1)) - 1) + self._rate_std
        self._rate_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
        faster = (n + 2) / 3
        self._rate_one = min(1.0, faster * 2 / ((n + 1.3) ** 2 + mass))
        many = faster * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self._rate_many = max(0.0, min(1 - self._rate_one, many))
        self._length = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))

    def ask(self) -> np.ndarray:
        """Return the samples of a generation, shape (population, n)."""
        steps = self.rng.normal(size=(self.population, len(self.mean)))
        return self.mean + self.std * np.sqrt(self.variance) * steps

    def tell(self, samples: np.ndarray, scores: np.ndarray) -> None:
        """Learn how good the samples of a generation are.

        Args:
            samples: What `ask` returned.
            scores: Their scores, higher is better, shape (population,).
        """
        best = np.argsort(-scores, kind="stable")[: len(self._weights)]
        steps = (samples[best] - self.mean) / self.std
        step = self._weights @ steps
        self.mean = self.mean + self.std * step
        whitened = step / np.sqrt(self.variance)
        c, d = self._rate_std, self._rate_path
        self._path_std = (1 - c) * self._path_std + np.sqrt(c * (2 - c) * self._mass) * whitened
        self._path = (1 - d) * self._path + np.sqrt(d * (2 - d) * self._mass) * step
        one, many = self._rate_one, self._rate_many
        spread = self._weights @ steps**2
        self.variance = (1 - one - many) * self.variance + one * self._path**2 + many * spread
        length = float(np.linalg.norm(self._path_std))
        self.std *= float(np.exp(min(c / self._damping * (length / self._length - 1), 1.0)))
