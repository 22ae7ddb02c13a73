"""The supervisor of the centralized variant."""
