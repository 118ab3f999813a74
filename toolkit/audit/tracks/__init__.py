"""Faults of the tracks: sightings that repeat, lack a half, stand in each other's place or fit no motion.

Read ``no_disparity`` for the smallest fault of all. Of single sightings: ``left_only``, ``no_sightings``,
``unknown_rows``, ``swapped_coordinates``, ``doubled_disparity``, ``coarse_pixels``. Of ids and frames:
``returning_tracks``, ``stale_frames``, ``thin_vision``, ``image_jump``. Of their errors: ``track_scatter``,
``correlated_tracks``.
"""
