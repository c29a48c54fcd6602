"""C kernels and their ctypes binding: stepping, matrix exponential, least squares.

Compiled from plain C at installation; entered once per block of communication steps.
"""
