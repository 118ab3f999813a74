"""What a comparison leaves behind: tables, words, JSON documents, trajectories, figures, one HTML page; nothing runs.

Reading order: table -> messages -> terminal, report_md -> scores_json, curves, report_json, records -> run_directory;
figures/ draws, html/ makes the page from run directories alone; gate shows a check of the gate.
"""
