"""A market of goals (Zlot, Stentz, Dias, Thayer 2002, as Puig, Garcia and Wu sum it up).

With a supervisor all tours are known and the market is central; without one, robots trade by registers.
`goals.py` proposes, `costs.py` values, `central.py` and `trader.py` sell. Start with `planner.py`.
"""
