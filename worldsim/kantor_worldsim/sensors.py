"""What a pose senses."""

import numpy as np

from kantor_protocol.kernels import kernel


@kernel
def sense_targets(
    targets_m: np.ndarray, found: np.ndarray, x: float, y: float, range_m: float, out: np.ndarray
) -> int:
    """Mark the targets within range that were not found yet; their number, indices in `out`.

    targets_m: (T, 2) world frame; found: (T,) bool; out: (T,) int64 room.
    """
    count = 0
    for i in range(targets_m.shape[0]):
        if not found[i]:
            dx = targets_m[i, 0] - x
            dy = targets_m[i, 1] - y
            if dx * dx + dy * dy <= range_m * range_m:
                found[i] = True
                out[count] = i
                count += 1
    return count
