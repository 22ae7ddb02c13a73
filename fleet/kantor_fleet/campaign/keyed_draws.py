"""Keyed draws in the shapes that a scenario takes. Numbers are short, so that a person can read them."""

from collections.abc import Sequence
from typing import TypeVar

from kantor_protocol.base.counter_rng import Purpose, uniform

_T = TypeVar("_T")


def short(value: float) -> float:
    """A number with four digits."""
    return float(f"{value:.4g}")


class KeyedDraws:
    """Draws about one subject, which change no draw about another."""

    def __init__(self, seed: int, subject: int) -> None:
        self._seed, self._subject, self._drawn = seed, subject, 0

    def unit(self) -> float:
        """In [0, 1)."""
        self._drawn += 1
        return float(uniform(self._seed, Purpose.CAMPAIGN.value, self._subject, self._drawn, 0))

    def coin(self, probability: float = 0.5) -> bool:
        """True with a probability."""
        return self.unit() < probability

    def between(self, low: float, high: float) -> float:
        """Evenly."""
        return short(low + self.unit() * (high - low))

    def scale(self, low: float, high: float) -> float:
        """Evenly over magnitudes; both above 0."""
        return short(low * (high / low) ** self.unit())

    def whole(self, low: int, high: int) -> int:
        """A whole number, both ends included."""
        return low + int(self.unit() * (high - low + 1))

    def one_of(self, options: Sequence[_T], weights: Sequence[float] | None = None) -> _T:
        """One of the options, all alike or by weight."""
        if weights is None:
            return options[int(self.unit() * len(options))]
        left = self.unit() * sum(weights)
        for option, weight in zip(options, weights, strict=True):
            left -= weight
            if left < 0.0:
                return option
        return options[-1]

    def some_of(self, options: Sequence[_T]) -> list[_T]:
        """One of them more often than not, sometimes any number, in their order."""
        if self.coin(0.6):
            return [self.one_of(options)]
        share = self.unit()
        return [option for option in options if self.coin(share)] or [self.one_of(options)]
