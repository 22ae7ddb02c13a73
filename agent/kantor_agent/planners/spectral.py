"""Spectral Multiscale Coverage (Mathew & Mezic): visit every place as often as the density asks.

With f_k the cosine modes of norm one on the domain, c_k the sums of f_k over all poses of all robots so
far, n their number and mu_k the mean of f_k over the density, S_k = c_k - n mu_k tells how far the visits
are from the density at the scale of mode k. Each robot descends the sum of Lambda_k S_k^2 / 2, large
scales first: Lambda_k = (1 + |k|^2)^(-3/2).

Each robot keeps the sum over its own poses as its register, in integers (`cosine_basis.py`), and plans with
the registers of the others that it holds: centralized and decentralized missions differ in whose those are.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.base import Goal
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.cosine_basis import harmonics, phase, rectangle_of, visit
from kantor_protocol.replication.registers import add
from kantor_protocol.scenario.schema import Domain, Gaussian, Scenario

_CELLS = 400
"""Midpoints along each axis by which a mixture is integrated over the domain."""
_PRECISION = 2.0**-40
"""Of a mean over a mixture. What is finer depends on how many numbers a processor adds at once."""
_VANISHING = 1e-13
"""A gradient below this share of the sum of its terms is rounding."""

Floats = npt.NDArray[np.float64]


@kernel
def gradient(
    total: np.ndarray,
    mean: np.ndarray,
    emphasis: np.ndarray,
    domain: np.ndarray,
    cos_x: np.ndarray,
    sin_x: np.ndarray,
    cos_y: np.ndarray,
    sin_y: np.ndarray,
) -> tuple[float, float]:
    """B = sum of Lambda_k S_k grad f_k, up to a factor; (0, 0) if it vanishes.

    total: (K * K,) the sums over visits; its first entry counts them. mean: (K * K,) of the modes over
    the density. emphasis: (K, K) Lambda_k / h_k^2, up to a factor. domain: x_min, y_min, Lx, Ly.
    """
    modes = cos_x.shape[0]
    b_x, b_y, size = 0.0, 0.0, 0.0
    for kx in range(modes):
        along, across = 0.0, 0.0
        for ky in range(modes):
            k = kx * modes + ky
            gap = emphasis[kx, ky] * (total[k] - total[0] * mean[k])
            along += gap * cos_y[ky]
            across += gap * ky * sin_y[ky]
            size += abs(gap) * (kx / domain[2] + ky / domain[3])
        b_x -= along * kx * sin_x[kx] / domain[2]
        b_y -= across * cos_x[kx] / domain[3]
    if math.sqrt(b_x * b_x + b_y * b_y) <= _VANISHING * size:
        return 0.0, 0.0
    return b_x, b_y


@kernel
def way_out(domain: np.ndarray, x: float, y: float, dx: float, dy: float) -> tuple[float, float]:
    """The point where the ray from (x, y) along (dx, dy) leaves the domain, sliding along a border it is on.

    From outside, the ray is the one to the nearest point inside. (x, y) itself if the ray has no length.
    """
    x_min, x_max = domain[0], domain[0] + domain[2]
    y_min, y_max = domain[1], domain[1] + domain[3]
    inside_x, inside_y = min(max(x, x_min), x_max), min(max(y, y_min), y_max)
    if inside_x != x or inside_y != y:
        dx, dy = inside_x - x, inside_y - y
    if (x <= x_min and dx < 0.0) or (x >= x_max and dx > 0.0):
        dx = 0.0
    if (y <= y_min and dy < 0.0) or (y >= y_max and dy > 0.0):
        dy = 0.0
    size = max(abs(dx), abs(dy))
    if size == 0.0:
        return x, y
    dx, dy = dx / size, dy / size
    reach = math.inf
    if dx != 0.0:
        reach = ((x_max if dx > 0.0 else x_min) - x) / dx
    if dy != 0.0:
        reach = min(reach, ((y_max if dy > 0.0 else y_min) - y) / dy)
    return min(max(x + reach * dx, x_min), x_max), min(max(y + reach * dy, y_min), y_max)


@kernel
def _choose(
    values: np.ndarray,
    total: np.ndarray,
    stamps: np.ndarray,
    me: int,
    mean: np.ndarray,
    emphasis: np.ndarray,
    domain: np.ndarray,
    cos_x: np.ndarray,
    sin_x: np.ndarray,
    cos_y: np.ndarray,
    sin_y: np.ndarray,
    visited: np.ndarray,
    x: float,
    y: float,
) -> tuple[float, float]:
    """Count the visit of (x, y), then return the goal of steepest descent."""
    harmonics(phase(x, domain[0], domain[2]), cos_x, sin_x)
    harmonics(phase(y, domain[1], domain[3]), cos_y, sin_y)
    visit(cos_x, cos_y, visited)
    add(values, total, stamps, me, visited)
    b_x, b_y = gradient(total, mean, emphasis, domain, cos_x, sin_x, cos_y, sin_y)
    return way_out(domain, x, y, -b_x, -b_y)


@kernel
def _mean_over(
    xy_m: np.ndarray,
    domain: np.ndarray,
    cos_x: np.ndarray,
    sin_x: np.ndarray,
    cos_y: np.ndarray,
    sin_y: np.ndarray,
    mean: np.ndarray,
) -> None:
    """Write the mean of each mode over samples (N, 2) into mean (K * K,); the harmonics are scratch."""
    modes = cos_x.shape[0]
    mean[:] = 0.0
    for j in range(xy_m.shape[0]):
        harmonics(phase(xy_m[j, 0], domain[0], domain[2]), cos_x, sin_x)
        harmonics(phase(xy_m[j, 1], domain[1], domain[3]), cos_y, sin_y)
        for kx in range(modes):
            for ky in range(modes):
                mean[kx * modes + ky] += cos_x[kx] * cos_y[ky]
    for k in range(modes * modes):
        mean[k] /= xy_m.shape[0]


def mean_over_mixture(density: tuple[Gaussian, ...], domain: Domain, modes: int) -> Floats | None:
    """The mean of each mode over a mixture cut to the domain: (K * K,), by 400 x 400 midpoints.

    A component is a product of two curves, so that two sums over 400 stand for one over 160,000. None
    if the mixture has no mass in the domain.
    """
    middle = (np.arange(_CELLS) + 0.5) / _CELLS
    cosines = np.cos(np.pi * np.outer(np.arange(modes), middle))
    moments = np.zeros((modes, modes))
    for component in density:
        factors = []
        for axis in range(2):
            low, high = domain.min_m[axis], domain.max_m[axis]
            off_m = low + (high - low) * middle - component.mean_m[axis]
            variance_m2 = component.variance_m2[axis]
            curve = np.exp(-(off_m**2) / (2.0 * variance_m2)) / math.sqrt(variance_m2)
            factors.append(cosines @ curve)
        moments += component.weight * np.outer(*factors)
    mass = moments[0, 0]
    if not mass > 0.0:
        return None
    return np.asarray(np.rint(moments / mass / _PRECISION) * _PRECISION).ravel()


class Spectral:
    """The planner `spectral` of Spectral Multiscale Coverage."""

    def __init__(self, scenario: Scenario) -> None:
        """The density is the scenario's mixture if that does not change with time, else its samples."""
        modes, domain, samples = scenario.planner.modes, scenario.domain, scenario.samples
        self._domain = rectangle_of(domain)
        order = np.arange(modes)
        weight = (1.0 + order[:, None] ** 2 + order[None, :] ** 2) ** -1.5
        norm = np.where(order > 0, 0.5, 1.0)  # h_k^2 / (Lx Ly) is the product of two of these
        self._emphasis = weight / np.outer(norm, norm)
        self._harmonics = tuple(np.zeros(modes) for _ in range(4))
        self._visited = np.zeros(modes * modes, dtype=np.int64)
        mean = None
        if samples.file is None and samples.diffusion_m == 0.0:
            mean = mean_over_mixture(scenario.density, domain, modes)
        self.mean = np.zeros(modes * modes) if mean is None else mean
        """(K * K,) the mean of each mode over the density."""
        self._follows_samples = mean is None
        self._walk_steps = -1

    def choose(self, belief: Belief, pose: Pose, _now_ns: int, /) -> Goal | None:
        """The point where the steepest descent leaves the domain: so far that no vehicle slows down before."""
        if self._follows_samples and belief.random_walk_steps != self._walk_steps:
            self._walk_steps = belief.random_walk_steps
            _mean_over(belief.grid.xy_m, self._domain, *self._harmonics, self.mean)
        registers = belief.registers
        x_m, y_m = _choose(
            registers.values,
            registers.total,
            registers.stamps,
            registers.me,
            self.mean,
            self._emphasis,
            self._domain,
            *self._harmonics,
            self._visited,
            pose.x_m,
            pose.y_m,
        )
        return None if (x_m, y_m) == (pose.x_m, pose.y_m) else Goal(x_m, y_m, sample=-1)
