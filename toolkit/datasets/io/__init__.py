"""Parts of the recording formats; no file here is a format.

Read ``fields`` (named arrays with their checks) and ``tables`` (CSV) first; ``npz_archive`` streams large arrays,
``yaml_fields`` and ``cameras`` read calibrations, ``image_pairs`` lists images, ``truth_file`` reads ground truth,
``euroc_*`` and ``tracks_along`` belong to EuRoC.
"""
