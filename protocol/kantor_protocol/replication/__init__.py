"""Replicated single-writer state: logs, claims and registers, exchanged by anti-entropy.

`replica.py` holds what a participant knows of everybody's logs and claims, `registers.py` the registers, and
`gossip.py` turns both into messages and back. No network and no clock: time and messages are arguments. Start with
`replica.py`.
"""
