"""Execute the notebooks and write their .ipynb files: python notebooks/execute.py [NAME.py ...]

Outputs are kept small and free of times and machine names, so that two executions differ where results do.
"""

import base64
import io
import re
import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).resolve().parent
TIMEOUT_S = 600
_COLOURS = 64


def sources() -> list[Path]:
    """Return the notebooks' sources in order."""
    return sorted(FOLDER.glob("[0-9][0-9]_*.py"))


def read_source(source: Path) -> nbformat.NotebookNode:
    """Return a source as a notebook without outputs; its cells are named by their place."""
    notebook = jupytext.read(source)
    for place, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{place:02d}"
        cell["metadata"] = {}
    notebook.metadata = {
        "jupytext": {"formats": "ipynb,py:percent"},
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    }
    return notebook


def execute(source: Path) -> nbformat.NotebookNode:
    """Return the notebook executed; raises nbclient's CellExecutionError where a cell fails."""
    notebook = read_source(source)
    resources = {"metadata": {"path": str(FOLDER)}}
    NotebookClient(notebook, timeout=TIMEOUT_S, record_timing=False, resources=resources).execute()
    notebook.metadata.pop("language_info", None)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            _make_small(output.get("data", {}))
    return notebook


def _make_small(data: dict[str, str]) -> None:
    """Reduce the colours of a picture, and drop what a notebook never shows of it."""
    if "image/png" not in data:
        return
    picture, small = Image.open(io.BytesIO(base64.b64decode(data["image/png"]))), io.BytesIO()
    # By coverage, not by frequency: a thin line in a colour of its own keeps it.
    few = picture.convert("RGB").quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(small, "PNG", optimize=True)
    data["image/png"] = base64.b64encode(small.getvalue()).decode()
    data["text/plain"] = re.sub(r" at 0x[0-9a-f]+", "", data.get("text/plain", ""))


def main(names: list[str]) -> None:
    """Execute the notebooks of the names, or all."""
    for source in sources():
        if names and source.name not in names:
            continue
        target = source.with_suffix(".ipynb")
        nbformat.write(execute(source), target)
        print(f"{target.name}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
