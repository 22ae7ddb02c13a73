"""Compiled kernels on disk.

What is compiled is found again by its content, whatever clone or environment it belongs to. Not here: the decorators
of kernels, which are in `base/kernels.py`, and the kernels. Start with `kernel_store.py`.
"""
