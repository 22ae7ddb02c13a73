"""The exchanges: how inputs reach participants and outputs come back.

In process, in lockstep over the bus, or in real time; with the lobby that admits processes and the injector of
process faults. World-sim's process begins in `main.py`. What a step means is decided in `engine`. Start with
`main.py`.
"""
