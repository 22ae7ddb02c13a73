"""Small replicas, and their state as plain values."""
