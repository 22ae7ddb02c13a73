"""Variable-length integers in plain Python."""


def leb128(value: int) -> bytes:
    """Seven bits a byte, low bits first, the high bit on all but the last."""
    out = bytearray()
    while value > 127:
        out.append(value % 128 + 128)
        value //= 128
    return bytes([*out, value])


def zigzag(value: int) -> int:
    """A signed number as an unsigned one: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return 2 * value if value >= 0 else -2 * value - 1
