"""The report as one HTML file that opens from disk: what run directories hold, laid side by side.

Reading order: payload (what is shown of what :mod:`toolkit.report.run_directory` reads) -> :func:`page_text` (one file
made of page.html, style.css and the scripts in ``scripts``): nothing is fetched, and no text of a recording is code.
"""

import base64
import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from toolkit.errors import printable
from toolkit.files.reading import read_input
from toolkit.files.writing import write_text
from toolkit.report.text import Table, as_html, in_html

# In the order in which they build upon each other; together they are the body of one function.
SCRIPTS = (
    *("dom", "numbers", "state", "hints", "table", "canvas", "gestures", "scene", "top_view", "orbit_view"),
    *("axes", "chart", "charts", "seeds", "words", "case", "main"),
)
_IMAGES = {".png": "image/png", ".svg": "image/svg+xml"}
# Characters that could end the script element or open a comment in it, or that older parsers take as the end of a line.
_ESCAPES = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}


def write_html(directories: Sequence[Path], target: Path) -> None:
    """Write the report of run directories, in the order given, to a file; the same directories give the same bytes.

    Raises DataError for a directory that cannot be read as one, OutputError where ``target`` cannot be written;
    nothing is left behind then.
    """
    # Here, because pages of other systems' trajectories are made without what reads a run directory.
    from toolkit.report.explanation import EXPLANATIONS
    from toolkit.report.html.payload import payload_of
    from toolkit.report.run_directory import read_run
    from toolkit.report.sweep import SWEEPS

    kinds = [(one, kind) for kind in (SWEEPS, EXPLANATIONS) for one in directories if (one / kind.document).is_file()]
    sections = {directory: kind.section(directory) for directory, kind in kinds}
    runs = [read_run(directory) for directory in directories if directory not in sections]
    write_text(target, page_text(payload_of(runs), "\n".join(sections.values())))


def page_text(payload: dict[str, Any], sections: str = "") -> str:
    """Return the page of a payload with its ``title``, and sections of HTML below; refuses NaN and infinity."""
    parts = {
        "title": html.escape(printable(payload["title"])),
        "style": source("style.css"),
        "payload": json_in_html(payload),
        "sections": sections,
        "script": "\n".join(source(f"scripts/{name}.js") for name in SCRIPTS),
    }
    return filled_page("page.html", parts)


def card(
    title: str, lines: Iterable[str] = (), table: Table | None = None, figures: Mapping[Path, str] | None = None
) -> str:
    """Return a card of a page: lines, a table with those under it, figures (file -> caption) with the images inside.

    A PDF is not shown in a page. Raises DataError where a figure is missing.
    """
    parts = [f"<h2>{in_html(title)}</h2>", *(f"<p>{in_html(line)}</p>" for line in lines)]
    if table is not None:
        parts.append(f'<div class="wide">{as_html(table)}</div>')
        parts += [f'<p class="fine">{in_html(line)}</p>' for line in table.under]
    for path, caption in (figures or {}).items():
        if path.suffix in _IMAGES:
            image, words = base64.b64encode(read_input(path)).decode("ascii"), in_html(caption)
            shown = f'<img src="data:{_IMAGES[path.suffix]};base64,{image}" alt="{words}" style="max-width: 100%">'
            parts.append(f"<figure>{shown}<figcaption>{words}</figcaption></figure>")
    return f'<section class="card results">{"".join(parts)}</section>'


def filled_page(name: str, parts: Mapping[str, str]) -> str:
    """Return a page of this folder with each place ``{{ part }}`` filled."""
    # One pass: a part that spells out one of the places must not be taken for one.
    return re.sub(r"{{ (\w+) }}", lambda place: parts[place[1]], source(name))


def json_in_html(value: object) -> str:
    """Return a value as JSON that is safe inside a script element: ``</script>`` and ``<!--`` cannot appear."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character, escape in _ESCAPES.items():
        text = text.replace(character, escape)
    # Bytes of a file's name that are no text: their escape is one of JSON's, too.
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def source(name: str) -> str:
    return files("toolkit.report.html").joinpath(name).read_text(encoding="utf-8")
