"""What a comparison leaves behind: the table, the JSON contract, trajectories, figures and the manifest."""
