"""Processes of a fleet: on this machine, one by one, in containers, and what observes them.

`local.py` starts and stops a whole fleet, `standalone.py` one process, `compose.py` writes container fleets and
`chaos.py` injects faults into them. Start with `local.py`.
"""
