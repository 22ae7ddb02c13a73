"""Execution of missions: in this process, as cases in pools of workers, and again from a record.

`in_process_team.py` plays a mission in this process, `experiment.py` runs a case for sweeps and campaigns in the
processes of `pools.py`, `verify.py` executes a record again; `fork_server.py` has processes start warm. Fleets of
processes on the bus are in `processes`. Start with `in_process_team.py`.
"""
