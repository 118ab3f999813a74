"""The accuracy gate: has a change made accuracy, consistency, held-out reprojection or speed worse than a baseline?

Reading order: baseline (what is kept), baseline_file (as JSON) -> measuring -> paired, bounded (how one metric is
judged) -> judging (a case) -> checking (the whole). How it is used and how well it sees: docs/gate.md.
"""
