"""Replicated single-writer state: logs, claims and registers, exchanged by anti-entropy.

`replica.py` holds the logs and claims of all participants as one knows them, `registers.py` the registers, and
`gossip.py` makes messages of both and merges received ones. With `trust = "signed"`, `attested.py` takes and sends of
others what these have attested: `proofs.py` checks that of a message, and `parts.py` reads its parts one by one. No
network and no clock: time and messages are arguments. Start with `replica.py`.
"""
