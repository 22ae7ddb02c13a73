"""Processes of a fleet: all on this machine, one by one, or in containers; and tools that observe and disturb them.

`mission.py` is `kantor run`, `local.py` starts and stops a whole fleet, `standalone.py` and `site.py` run one process,
`compose.py` writes container fleets, `chaos.py` injects faults into them. Algorithms and rules are in the packages
below. Start with `mission.py`.
"""
