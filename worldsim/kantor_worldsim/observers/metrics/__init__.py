"""Metrics of a run, computed from its records alone.

`base.py` holds what every run has, `density.py` and `mapping.py` the two kinds of mission, `result.py` the Structs of
`result.json`. Whether a rule was broken is the checkers' question. Start with `base.py`.
"""
