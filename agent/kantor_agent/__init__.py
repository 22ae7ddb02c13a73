"""A robot: belief, planners, vehicles, and the state machine that joins them."""
