"""Planners, one file or folder each; none imports another.

`base.py` is the interface of planners on densities, `map_base.py` of those on maps; `registry.py` and
`map_registry.py` name them and say how to add one.
A planner knows neither vehicle, radio nor clock. Start with `base.py` and `transport.py`.
"""
