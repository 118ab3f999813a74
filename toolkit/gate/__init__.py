"""The accuracy gate: has a change made accuracy, consistency, held-out reprojection or speed other than a baseline's?

Reading order: baseline (what is kept), baseline_file (as JSON) -> measuring -> verdict, significance (how a metric is
tested) -> judging (a case) -> checking (the whole). Beside it: interleaved (speed against another version of the code,
each in a process of timing_child), and trajectory_files -> trajectory_baseline -> trajectory_check (another system's
files, without a run). How it is used and how well it sees: docs/gate.md.
"""
