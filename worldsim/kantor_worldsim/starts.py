"""Where robots can be, and what they can ever see."""

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from kantor_protocol.grid import FREE
from kantor_worldsim.maps import Ground


def observable(ground: Ground, starts_m: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """(rows, columns) cells that can ever be seen: where robots can go, and the walls beside."""
    free = ground.cells == FREE
    parts, _ = ndimage.label(free)
    starts = [
        divmod(ground.frame.cell_of(x, y), ground.frame.columns) for x, y in starts_m.tolist()
    ]
    inside = np.isin(parts, [parts[start] for start in starts]) & free
    beside = ndimage.binary_dilation(inside) & ~free
    return np.asarray(inside | beside)
