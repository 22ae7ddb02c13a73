"""Campaigns: many missions full of faults, drawn from seeds, with every checker on.

`draw.py` makes a scenario of a seed, `mission.py` runs and judges it, `shrink.py` makes a failing one small,
`processes.py` does the same on real processes. Start with `run.py`.
"""
