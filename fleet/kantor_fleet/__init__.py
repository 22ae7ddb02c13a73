"""The `kantor` command: fleets, runs, reports, campaigns, sweeps and the papers' figures.

`cli` holds one file for each verb, the other rooms what the verbs do. Algorithms and rules are in the packages below.
Start with `cli`.
"""
