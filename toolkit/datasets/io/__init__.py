"""Parts of the recording formats; no file here is a format.

Read ``fields`` (named values with their checks, and YAML) and ``tables`` (CSV) first; ``image_pairs`` lists images and
checks them, ``truth`` reads ground truth, ``numpy_files`` archives and object arrays without running anything.
``euroc_calibration`` is EuRoC's and Kalibr's, ``bag_reader`` is for bags.
"""
