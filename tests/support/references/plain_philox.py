"""The generator of keyed draws in plain integers, the reference of the compiled form."""


def philox_plain(seed: int, counter: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """Philox4x32-10 (Salmon et al. 2011): the four words of a counter."""
    words, key = list(counter), [seed & 0xFFFFFFFF, seed >> 32]
    for _ in range(10):
        product_0, product_1 = 0xD2511F53 * words[0], 0xCD9E8D57 * words[2]
        words = [
            (product_1 >> 32) ^ words[1] ^ key[0],
            product_1 & 0xFFFFFFFF,
            (product_0 >> 32) ^ words[3] ^ key[1],
            product_0 & 0xFFFFFFFF,
        ]
        key = [(key[0] + 0x9E3779B9) & 0xFFFFFFFF, (key[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return words[0], words[1], words[2], words[3]
