"""The knowledge of a robot on a map: the fused map, the cost of crossing its cells, and ways over it.

`fused_map.py` sums the evidence layers of all robots, `cost_map.py` and `routes.py` give distances, `navigation.py`
the next place to head for. Planners decide which frontier to take. Start with `fused_map.py`.
"""
