"""Faults of the tracks: sightings that repeat, lack an image, have exchanged coordinates or fit no motion.

Read ``no_disparity`` first, the shortest file. Faults of sightings are ``left_only``, ``no_sightings``,
``unknown_rows``, ``swapped_coordinates``, ``doubled_disparity`` and ``coarse_pixels``; of ids and frames
``returning_tracks``, ``stale_frames``, ``thin_vision`` and ``image_jump``; of the statistics of errors
``track_scatter`` and ``correlated_tracks``.
"""
