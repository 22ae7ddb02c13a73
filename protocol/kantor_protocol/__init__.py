"""What every kantor process shares: the state machine, the messages, replication, the bus."""
