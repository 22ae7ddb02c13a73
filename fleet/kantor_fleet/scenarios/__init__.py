"""The packaged scenarios, one TOML file each.

`catalog.py` finds a scenario by name or by file. What its tables mean is in `kantor_protocol.scenario`.
"""
