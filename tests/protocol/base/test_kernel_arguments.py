"""Kernels take few arguments: what belongs together is one NamedTuple, or at the border to Python its plain tuple.

Loose arguments were typed again in each file that handed them on, and nothing but their order told them apart.
"""

import importlib
import pkgutil
from types import ModuleType

import kantor_agent
import kantor_fleet
import kantor_protocol
import kantor_supervisor
import kantor_worldsim
from kantor_protocol.base.kernels import Kernel

ARGUMENTS_MAX = 8

WITH_MORE = {
    "agent.belief.belief._drop_empty": 10,
    "agent.belief.belief._ship_packed": 26,
    "agent.mapping.fused_map._fold": 13,
    "agent.mapping.routes.spread_by_buckets": 13,
    "agent.mapping.routes.spread_by_heap": 10,
    "agent.planners.burgard.discount": 9,
    "agent.planners.burgard.pick": 12,
    "agent.planners.kmeans.cluster": 9,
    "agent.planners.kmeans.measure_inaccessible": 9,
    "agent.planners.spectral._choose": 14,
    "agent.planners.transport._choose": 18,
    "protocol.replication.occupancy_log._follow_beam": 10,
    "protocol.replication.occupancy_log._read_scan": 11,
    "protocol.replication.registers._compose": 11,
    "protocol.replication.registers._is_due": 9,
    "protocol.replication.registers._merge": 10,
    "protocol.replication.replica_kernels.compose": 13,
    "protocol.replication.replica_kernels.is_mergeable": 14,
    "protocol.replication.replica_kernels.merge": 14,
    "worldsim.exchange.admission_kernels._check_entry": 10,
    "worldsim.exchange.admission_kernels.judge": 12,
    "worldsim.radio.channel._in_range": 11,
    "worldsim.world.sensors._scan": 11,
    "worldsim.world.sensors.sense_targets_in_sight": 10,
}
"""Kernels of one message, of one step or of the radio, which are called so often that a tuple at the border counts, or
that wait for their turn. Nothing is added to this list."""

PACKAGES = (kantor_agent, kantor_fleet, kantor_protocol, kantor_supervisor, kantor_worldsim)


def modules(package: ModuleType) -> list[ModuleType]:
    """All modules of a package."""
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    return [importlib.import_module(each.name) for each in found if "__main__" not in each.name]


def arguments() -> dict[str, int]:
    """The number of arguments of each kernel, by its module and name."""
    kernels = {
        value
        for package in PACKAGES
        for module in modules(package)
        for value in vars(module).values()
        if isinstance(value, Kernel)
    }
    functions = [each.py_func for each in kernels]
    return {
        f"{each.__module__.removeprefix('kantor_')}.{each.__name__}": each.__code__.co_argcount
        for each in functions
    }


def test_no_kernel_takes_more_than_a_handful_of_arguments() -> None:
    """No kernel of a batch; of the others in the list none gets more, and whoever needs no place there has none."""
    many = {name: count for name, count in arguments().items() if count > ARGUMENTS_MAX}

    assert many == {name: WITH_MORE[name] for name in many if name in WITH_MORE}
    assert many.keys() == WITH_MORE.keys()
