"""What several faults share; no file here is a fault.

Read ``vision`` (the camera's motion from its own tracks), ``intervals`` (that motion beside the motion samples), then
``robust`` (statistics), ``tracks`` and ``subsets`` (edits of a sequence).
"""
