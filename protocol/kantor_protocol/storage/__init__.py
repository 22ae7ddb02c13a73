"""Files that kantor itself writes, whole or not at all, and secrets among them for their owner only.

Files that others wrote are read in `files`; what a run leaves is described where it is made, in world-sim's `record`.
Start with `drafts.py`.
"""
