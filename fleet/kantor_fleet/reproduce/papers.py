"""The figures of all papers by name."""

from kantor_fleet.reproduce import burgard, kabir_lee, kme, resilience
from kantor_fleet.reproduce.figure import PaperFigure

FIGURES = kabir_lee.FIGURES | burgard.FIGURES | kme.FIGURES | resilience.FIGURES


def figures(name: str) -> dict[str, PaperFigure]:
    """The figure of this name, or with `all` those of the first paper: the others take long."""
    return kabir_lee.FIGURES if name == "all" else {name: FIGURES[name]}
