"""The radio: which receivers an envelope reaches, when, and which copies are lost or forged.

`channel.py` decides range, delay and loss; `link_faults.py` applies the scenario's faults of links with the
kernels of `fault_kernels.py`. This is the only place that enforces range. Start with `channel.py`.
"""
