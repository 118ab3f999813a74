"""What a comparison leaves behind: tables, words, JSON documents, trajectories, figures, one HTML page; nothing runs.

Reading order: table -> messages -> terminal, report_md -> scores_json, curves, report_json, records -> run_directory;
figures/ draws; run_files reads a run directory, html/ makes the page of some; gate shows a check of the gate; schemas
writes docs/schemas.
"""
