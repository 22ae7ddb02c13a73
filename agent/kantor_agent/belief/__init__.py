"""What a robot on a density believes: the weight that is left on each sample, and where the samples are.

`belief.py` spends and merges weight, `sample_index.py` finds the nearest samples with weight. Choosing between them
is the planner's work. Start with `belief.py`.
"""
