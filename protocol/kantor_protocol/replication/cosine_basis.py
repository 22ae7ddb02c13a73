"""Cosine modes on a rectangle, and the amounts that a visit adds to the sums over them.

The K x K modes cos(kx pi x / Lx) cos(ky pi y / Ly), kx and ky from 0 to K - 1, with x and y from the
lower left corner of the domain, are the basis of Spectral Multiscale Coverage (Mathew & Mezic) without
its norm. Row by row: mode (kx, ky) stands at kx K + ky. A rectangle is (x_min, y_min, Lx, Ly) in metres.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Domain

VISIT = 1 << 12
"""The amount that a visit adds where a mode is 1. After n visits a sum is wrong by some sqrt(n) / 14000 visits."""

_INSET = 0.002
"""No place is taken nearer to a border than this share of the extent. On the border every mode is level
across it, so that a robot which slides along it would never turn away."""


@kernel
def phase(x: float, low: float, extent: float) -> float:
    """The angle of mode 1 at a coordinate, within (0, pi); what lies outside counts as the border."""
    return math.pi * min(max((x - low) / extent, _INSET), 1.0 - _INSET)


@kernel
def harmonics(angle: float, cosines: np.ndarray, sines: np.ndarray) -> None:
    """cos(k angle) and sin(k angle) for k = 0, 1, ... by the recurrence of Chebyshev."""
    cosine, sine = math.cos(angle), math.sin(angle)
    cosines[0], sines[0] = 1.0, 0.0
    if cosines.shape[0] > 1:
        cosines[1], sines[1] = cosine, sine
    for k in range(2, cosines.shape[0]):
        cosines[k] = 2.0 * cosine * cosines[k - 1] - cosines[k - 2]
        sines[k] = 2.0 * cosine * sines[k - 1] - sines[k - 2]


@kernel
def visit(cos_x: np.ndarray, cos_y: np.ndarray, visited: np.ndarray) -> None:
    """Write to `visited` (K * K,) the amount that a visit adds to the sum over each mode, rounded to integers."""
    modes = cos_x.shape[0]
    for kx in range(modes):
        for ky in range(modes):
            visited[kx * modes + ky] = math.floor(VISIT * cos_x[kx] * cos_y[ky] + 0.5)


def rectangle_of(domain: Domain) -> npt.NDArray[np.float64]:
    """(4,) x_min, y_min, Lx, Ly."""
    return np.array([*domain.min_m, *np.subtract(domain.max_m, domain.min_m)])


def visit_at(
    x_m: float, y_m: float, rectangle: npt.NDArray[np.float64], modes: int
) -> npt.NDArray[np.int64]:
    """(K * K,) the amounts that a visit at one place adds. Coordinates in the world frame."""
    visited = np.zeros(modes * modes, dtype=np.int64)
    _visit_at(x_m, y_m, rectangle, np.zeros((3, modes)), visited)
    return visited


@kernel
def _visit_at(
    x_m: float, y_m: float, rectangle: np.ndarray, room: np.ndarray, visited: np.ndarray
) -> None:
    cos_x, cos_y, sines = room[0], room[1], room[2]
    harmonics(phase(x_m, rectangle[0], rectangle[2]), cos_x, sines)
    harmonics(phase(y_m, rectangle[1], rectangle[3]), cos_y, sines)
    visit(cos_x, cos_y, visited)
