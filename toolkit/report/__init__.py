"""What a comparison leaves behind: tables, words, JSON documents, trajectories, figures, one HTML page; nothing runs.

Reading order: table, prose -> comparison_table, messages -> comparison_text -> scores_json, curves, report_json,
manifest, all by records -> camera_frames -> run_directory; figures/ draws; run_files reads a run directory, html/ makes
the page of some, differences compares two, export passes one on. gate, evaluation_text (with evaluation_files), card,
verify_text and citations show what commands of their own find; schemas writes docs/schemas.
"""
