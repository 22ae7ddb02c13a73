"""Replicated single-writer state: logs, claims and registers, exchanged by anti-entropy.

`replica.py` holds the logs and claims of all participants as one knows them, `registers.py` the registers, and
`gossip.py` makes messages of both and merges received ones. No network and no clock: time and messages are arguments. Start with
`replica.py`.
"""
