"""The exact Wasserstein distance with which the bounds of Theorems 1-3 are compared.

Solved as a linear program by POT's network simplex. Seconds for thousands of points, so it is asked
for at a few moments only; POT is an extra (`pip install kantor[exact]`).
"""

import importlib.util

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]

_ITERATIONS_MAX = 50_000_000
AFFORDABLE = 400_000_000
"""Pairs of points whose distances fit into memory, 8 bytes each."""
ROUNDING = 1e-6
"""Relative: what the solver's floating point may differ by."""


def available() -> bool:
    """Whether POT is installed."""
    return importlib.util.find_spec("ot") is not None


def w1(
    here_m: Points,
    here_mass: npt.NDArray[np.float64],
    there_m: Points,
    there_mass: npt.NDArray[np.float64],
) -> float:
    """W_1 between two weighted sets of points with the Euclidean distance, in metres.

    here_m (n, 2), here_mass (n,), there_m (m, 2), there_mass (m,). Each side's mass is scaled to 1;
    neither may be empty. Raises RuntimeError when the solver gives up.
    """
    import ot  # noqa: PLC0415  an extra, and slow to import

    here, there = here_mass > 0.0, there_mass > 0.0
    cost, log = ot.emd2(
        here_mass[here] / here_mass.sum(),
        there_mass[there] / there_mass.sum(),
        ot.dist(here_m[here], there_m[there], metric="euclidean"),
        numItermax=_ITERATIONS_MAX,
        log=True,
    )
    if log["warning"]:
        raise RuntimeError(f"no exact distance: {log['warning']}")
    return float(cost)
