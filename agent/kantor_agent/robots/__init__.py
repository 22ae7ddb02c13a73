"""The two state machines of a robot, each with the one entrance `step`.

They call belief or map, planner, vehicle and gossip in the order of a step; the parts themselves are in the other
rooms. Start with `density.py`.
"""
