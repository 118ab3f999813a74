"""Parts of the recording formats; no file here is a format.

Read ``fields`` (named arrays with their checks) and ``tables`` (CSV) first; ``image_pairs`` lists images and checks
them, ``truth`` reads ground truth, ``yaml_fields`` calibrations, ``numpy_files`` archives and object arrays without
running anything. ``euroc_calibration`` is EuRoC's and Kalibr's, ``bag_reader``, ``bag_topics``, ``bag_calibration`` and
``ros_values`` are for bags. ``unrecognised`` explains why a path is no recording.
"""
