"""A schedule of faults: every kind by its name in a file, and a list of them."""

from typing import Annotated, get_args

from msgspec import Meta

from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.liars import Byzantine
from kantor_protocol.scenario.faults.links import LinkFault
from kantor_protocol.scenario.faults.processes import ProcessFault
from kantor_protocol.scenario.types import ScenarioTable

AnyFault = LinkFault | ProcessFault | Byzantine
"""The faults that a list may hold."""


FAULTS_MAX = 1000


KINDS: dict[str, type[Fault]] = {str(k.__struct_config__.tag): k for k in get_args(AnyFault)}
"""The kinds of faults by their names in a file."""


class Chaos(ScenarioTable, frozen=True, kw_only=True):
    """A schedule of faults in a file of its own, which may be added to any scenario."""

    faults: Annotated[tuple[AnyFault, ...], Meta(min_length=1, max_length=FAULTS_MAX)]


def kind_of(fault: Fault) -> str:
    """The name of a fault's kind in a file."""
    return str(fault.__struct_config__.tag)
