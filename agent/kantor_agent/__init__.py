"""A robot: belief and maps, planners, vehicles, and the state machines that join them.

Two machines: `robots/density.py` explores a density, `robots/mapping.py` an unknown map. No module here knows the
truth, other processes or the bus; `process.py` hands the machine to `kantor_protocol.node`. Start with
`robots/density.py`.
"""
