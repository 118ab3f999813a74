"""Parts of the recording formats; no file here is a format.

Read ``fields`` (named arrays with their checks) and ``tables`` (CSV) first; ``npz_archive`` streams large arrays,
``yaml_fields`` reads calibrations, ``image_pairs`` lists images and checks them, ``truth`` reads ground truth;
``euroc_*`` belongs to EuRoC, ``bag_*`` to bags.
"""
