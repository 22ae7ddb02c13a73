"""A participant as a process: it steps a state machine with what arrives on the bus.

`runner.py` is the loop of the process, `recovery.py` its exactly-once steps, `wal.py` the write-ahead log on disk.
Which machine is stepped is the caller's choice. Start with `recovery.py`, then `runner.py`.
"""
