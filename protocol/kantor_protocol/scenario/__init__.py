"""Scenarios: everything that defines a run but its seed.

`schema.py` holds the Structs, one for each table of the TOML file; `load.py` reads, `validate.py` and
`validate_faults.py` refuse scenarios that cannot be run, `dump.py` writes. What a fault does to messages or processes is not
here but in world-sim. Start with `schema.py`.
"""
