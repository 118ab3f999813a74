"""The kernels of the filters, compiled by numba: NumPy is the definition, a kernel is the same in loops over tracks.

Kernels of the windowed filters are ``track_gate`` and ``tracks_in_view``, each named after the NumPy code it replaces.
They are made of ``algebra`` and ``sightings``; ``signatures`` has the types of their arguments, ``compiling`` how they
are compiled and cached. Only this package imports numba.

The code is written to compile quickly, and array expressions compile slowly: so it has loops over scalars, results
written to arrays that the caller passes, and contiguous arrays only. Thresholds and numbers of iterations are
arguments.
"""
