"""Everything a comparison leaves behind: tables, text, JSON, trajectories, figures, a page; nothing is run here.

Reading order: text -> scores, card, messages -> headers -> comparison_table -> report_json and manifest (each JSON
document with the function that fills it; docs/site/schemas.py lists all of them) -> run_directory, which writes and
reads directories. curves has what is drawn; figures/ draws it, html/ makes the page of run directories. differences
compares two, export passes one on. sweep and explanation have all that shows one. gate, evaluation and citations show
the results of other commands.
"""

from typing import Literal

# Here, where the help of the command line finds them without what draws.
FigureChoice = Literal["few", "all", "none"]
FigureFormat = Literal["png", "pdf", "svg"]
