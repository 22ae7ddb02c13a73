"""The Zenoh bus: the only room that imports zenoh.

Routers (world-sim's and a site's), clients, endpoints, credentials, access control and rate limits. Callbacks only
enqueue; no decision about a mission is made here. Start with `router.py` and `client.py`.
"""
