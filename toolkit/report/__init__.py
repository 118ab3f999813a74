"""Everything a comparison leaves behind: tables, text, JSON, trajectories, figures, a page; nothing is run here.

Reading order: table, prose -> comparison_table, verdict, messages -> comparison_text -> score_records and records (the
JSON documents) -> scores_json, curves, report_json and manifest, which fill them -> camera_frames -> run_directory,
which writes and reads a run directory. figures/ draws, html/ makes the page of run directories, both with the colours
of looks; differences compares two, export passes one on. gate, evaluation_text (with evaluation_files), card,
verify_text and citations show the results of other commands; schemas writes docs/schemas.
"""
