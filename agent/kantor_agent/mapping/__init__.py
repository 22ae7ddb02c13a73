"""What a robot on a map knows of it: the fused map, the cost of crossing it, and ways over it.

`fused_map.py` sums everybody's layers, `cost_map.py` and `routes.py` give distances, `navigation.py` the next place
to head for. Which frontier to take is decided by planners. Start with `fused_map.py`.
"""
