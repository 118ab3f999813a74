"""Everything a comparison leaves behind: tables, text, JSON, trajectories, figures, a page; nothing is run here.

Reading order: text (words, numbers, tables) -> comparison_table, verdict, messages -> comparison_text -> scores,
records, curves, report_json and manifest (the JSON documents) -> camera_frames -> run_directory, which writes and reads
a run directory. figures/ draws, html/ makes the page of run directories, both with the colours
of looks; differences compares two, export passes one on. gate, evaluation_text (with evaluation_files), card,
verify_text and citations show the results of other commands; schemas writes docs/schemas.
"""
