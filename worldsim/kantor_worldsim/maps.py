"""True maps."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.grid import Frame

Cells = npt.NDArray[np.uint8]


class Ground(NamedTuple):
    """The true map."""

    frame: Frame
    cells: Cells
    """(rows, columns) of UNKNOWN, FREE or OCCUPIED; row 0 is lowest."""
