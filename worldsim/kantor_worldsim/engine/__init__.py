"""The simulation: truth, radio and record together, and the loop in virtual time.

`simulation.py` turns steps into records, `event_loop.py` decides which participants step when, `process_faults.py`
schedules faults of processes. How outputs are obtained from participants is the exchange's work. Start with
`simulation.py`.
"""
