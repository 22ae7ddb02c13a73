"""The random walk of samples and targets (Kabir & Lee, eq. 13-14), evaluated by every process alone."""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, philox, to_unit
from kantor_protocol.base.kernels import kernel


@kernel
def _walk(xy_m: np.ndarray, seed: int, purpose: int, step: int, diffusion_m: float) -> None:
    for j in range(xy_m.shape[0]):
        word_x, word_y = philox(seed, purpose, 0, step, j)
        xy_m[j, 0] += diffusion_m * (2.0 * to_unit(word_x) - 1.0)
        xy_m[j, 1] += diffusion_m * (2.0 * to_unit(word_y) - 1.0)


class RandomWalk:
    """Points of which each makes one uniform step in [-v, v]^2 a period: y <- y + v w.

    The draw of point j at step k depends on (seed, purpose, k, j) alone, so every process that
    holds the initial points holds the same points at the same simulated time, without a message.
    """

    def __init__(
        self,
        xy_m: npt.NDArray[np.float64],
        diffusion_m: float,
        period_ns: int,
        seed: int,
        purpose: Purpose,
        *,
        most_steps: int | None = None,
    ) -> None:
        """xy_m: (N, 2) points at time 0, in the world frame. They are copied.

        most_steps: in one `advance`, whatever the clock says; the rest follows with the next. None: any.
        """
        self.xy_m = np.array(xy_m, dtype=np.float64, order="C")
        self.steps = 0
        self._diffusion_m = diffusion_m
        self._period_ns = period_ns
        self._seed = seed
        self._purpose = int(purpose)
        self._most_steps = most_steps

    def advance(self, now_ns: int) -> bool:
        """Bring `xy_m` to simulated time `now_ns`, never back; True if the points moved."""
        if not self._diffusion_m > 0.0:
            return False
        due = now_ns // self._period_ns
        moved = due > self.steps
        if moved and self._most_steps is not None:
            due = min(due, self.steps + self._most_steps)
        while self.steps < due:
            self.steps += 1
            _walk(self.xy_m, self._seed, self._purpose, self.steps, self._diffusion_m)
        return moved
