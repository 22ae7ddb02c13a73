"""Execution of missions: one run as a value, pools of workers, verification of a run folder.

`mission.py` runs a mission from start to picture, `experiment.py` a case for sweeps and campaigns, `verify.py`
executes a record again. Start with `mission.py`.
"""
