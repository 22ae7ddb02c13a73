"""The private authority of a fleet: it issues, renews and revokes the certificates of its members.

How a certificate is used on the bus is in `kantor_protocol.transport`. Start with `authority.py`.
"""
