"""What several faults share; no file here is a fault.

Read ``intervals`` (the camera's motion, of ``models.camera_motion``, beside the motion samples), then
``robust`` (statistics), ``tracks`` and ``subsets`` (edits of a sequence).
"""
