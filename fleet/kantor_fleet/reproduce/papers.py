"""The figures of all papers by name."""

from kantor_fleet.reproduce import burgard, kabir_lee, kme, resilience
from kantor_fleet.reproduce.figure import PaperFigure

FIGURES = kabir_lee.FIGURES | burgard.FIGURES | kme.FIGURES | resilience.FIGURES


def figures(name: str) -> dict[str, PaperFigure]:
    """One, or `all` of the first paper: the others take long and are asked for by name."""
    return kabir_lee.FIGURES if name == "all" else {name: FIGURES[name]}
