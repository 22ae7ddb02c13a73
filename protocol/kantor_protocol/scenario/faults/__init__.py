"""Faults as data: which faults are injected into a run, and when.

A scenario lists them as `[[faults]]`, each of a `kind` and within a window of simulated time. The Structs define what
each kind may set; whether a list can apply to a scenario is decided in `validate_faults.py`, and world-sim injects
them. Start with `base.py`.
"""
