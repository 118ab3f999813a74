"""What a comparison leaves behind: the table, the JSON contract, trajectories, figures and the manifest.

Reading order: session -> comparison -> table -> records -> scores_json -> run_directory -> figures.
"""
