"""The style of kantor's pictures: plain axes, few colours, labels beside the marks."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import SubFigure

TEXT_PT, SMALL_PT, TITLE_PT = 9.5, 8.5, 12.5
INK, FAINT, EMPTY = "#222222", "#8c8c8c", "#d9d9d9"
FOUND, MISSED = "#00875a", "#111111"
KILLED = "#c1121f"
"""The colour of places and times at which a process was killed."""
CUT = "#9aa5b1"
"""The colour of times in which links were cut."""
FIRST, SECOND, THIRD = INK, "#3f90da", "#e76300"
"""The colours of the lines of a diagram, in this order."""
TEAM = (
    "#3f90da",
    "#ffa90e",
    "#bd1f01",
    "#832db6",
    "#a96b59",
    "#e76300",
    "#b9ac70",
    "#92dadd",
    "#717581",
    "#94a4a2",
)
"""Petroff's ten colours, distinct for any colour vision; the greys last, since samples are grey."""


def tidy(axes: Axes, x_label: str, y_label: str) -> None:
    """Style axes: two spines, small ticks."""
    axes.set_xlabel(x_label, size=TEXT_PT, color=INK)
    axes.set_ylabel(y_label, size=TEXT_PT, color=INK)
    axes.tick_params(labelsize=SMALL_PT, labelcolor=INK, color=FAINT, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)


def add_caption(axes: Axes, handles: Sequence[Artist], columns: int = 3) -> None:
    """Add the legend of a diagram above it, where no line crosses it."""
    axes.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        borderpad=0.0,
        ncols=columns,
        frameon=False,
        fontsize=TEXT_PT,
        handlelength=1.4,
        columnspacing=1.4,
        labelcolor=INK,
    )


def add_legend(place: SubFigure, handles: Sequence[Artist], widest: int = 6) -> None:
    """Add the legend of a part of the picture below it, in one row of at most `widest` entries, or in two."""
    legend = place.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles) if len(handles) <= widest else -(-len(handles) // 2),
        frameon=False,
        fontsize=TEXT_PT,
        handlelength=1.6,
        columnspacing=1.6,
        labelcolor=INK,
    )
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):  # marks of many points are too small to recognise
            handle.set_sizes(np.maximum(handle.get_sizes(), 12.0))


def team_colours(robots: int) -> list[str]:
    """A colour for each robot. Beyond ten robots only neighbours are clearly distinct, along a cyclic map."""
    if robots <= len(TEAM):
        return list(TEAM[:robots])
    golden = 0.6180339887498949  # its multiples fall evenly, and far from the one before
    around = golden * np.arange(robots) % 1.0
    # Twilight is pale at 0 and dark at 1/2; keep to its blue and its red side.
    places = np.where(around < 0.5, 0.12, 0.28) + 0.6 * around
    return [to_hex(colour) for colour in colormaps["twilight"](places)]
