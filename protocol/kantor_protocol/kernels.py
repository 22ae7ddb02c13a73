"""How kernels are compiled: for speed, to be called often, and kept on disk."""

from numba import njit

kernel = njit(cache=True, error_model="numpy", _nrt=False)
"""Compiles a function that allocates nothing. Numba then counts no references to its arrays, which
would cost more than the work itself; at the border to Python an array costs 0.02 us. A NamedTuple of
arrays costs a whole one there, so what is called in every step takes the fields one by one."""

sum_kernel = njit(cache=True, error_model="numpy", _nrt=False, fastmath={"reassoc"})
"""For a long sum of which the last digits do not matter: its terms are added in whatever order the
processor is fastest, four times as fast as one by one."""
