"""The supervisor of the centralized variant: one more participant, with a place and a radio of its own.

`density.py` merges weights (Kabir & Lee, Algorithm 2), `mapping.py` gathers layers and assigns targets. The supervisor
knows only what robots send it; the truth is not within its reach. Start with `density.py`.
"""
