"""The state machine contract and the value types that everything else stands on.

Here belong pure types and compiled primitives without knowledge of scenarios or messages: poses and envelopes,
keyed random draws, grids, variable-length integers, the random walk. Start with `machine.py`.
"""
