"""What filters have compiled by numba: NumPy is the definition, of which these are loops over tracks.

``track_gate``, ``tracks_in_view``, ``corrections`` and, along an IMU's samples, ``preintegration`` are the kernels of
the windowed filters, ``decoupled`` and, along twists, ``twists`` those of the decoupled one, named after what they
stand for; ``algebra``, ``sightings`` and ``rigid_motions`` what they are made of, ``signatures`` what they take,
``compiling`` how they are compiled and kept. Only this package imports numba.

It is written for a short compilation, which whole arrays in expressions make long: loops over scalars, results put in
arrays that are given, everything contiguous. Rules (thresholds, numbers of iterations) are arguments.
"""
