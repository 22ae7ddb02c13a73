"""A market of goals (Zlot, Stentz, Dias, Thayer 2002, as Puig, Garcia and Wu sum it up).

With a supervisor all tours are known and the market is central; without one, robots trade by registers.
`goals.py` proposes goals, `costs.py` values them, `rules.py` has what both forms share, `central.py` is the market of
a supervisor, `trader.py` that of a robot, whose memos are in `memo.py`. Start with `planner.py`.
"""
