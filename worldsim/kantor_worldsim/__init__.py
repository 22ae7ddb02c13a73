"""World-sim: the truth, the radio, the record of a run, and the observers that judge it.

Layers, lowest first: world, radio, record, then engine and observers side by side, and exchange on top. Robots and
planners are not known here. Start with `engine/simulation.py`.
"""
