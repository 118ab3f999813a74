"""Parts of the recording formats; no file here is a format.

Read ``fields`` (named arrays with their checks) and ``tables`` (CSV) first; ``image_pairs`` lists images and checks
them, ``truth`` reads ground truth, ``yaml_fields`` calibrations. ``numpy_files`` reads archives and object
arrays and runs nothing. ``euroc_calibration`` and ``euroc_truth`` are EuRoC's,
``bag_reader``, ``bag_topics``, ``bag_calibration`` and ``ros_values`` are for bags. ``unrecognised`` explains why a
path is no recording.
"""
