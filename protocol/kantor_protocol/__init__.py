"""The common part of all kantor processes: the state machine, scenarios, messages, replication and the bus.

Nothing here knows a planner, the world or a checker. Start with `base/machine.py` (the contract of a participant),
then `wire/messages.py` and `replication/gossip.py`. Layers, lowest first: base, scenario, wire, then replication
and transport side by side, and node on top.
"""
