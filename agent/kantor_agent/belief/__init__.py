"""The belief of a robot about a density: the weight left on each sample, and where the samples are.

`belief.py` spends and merges weight, `sample_index.py` finds the nearest samples with weight. Choosing between them
is the planner's work. Start with `belief.py`.
"""
