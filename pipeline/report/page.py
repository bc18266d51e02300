"""One HTML page that stands alone: sections of tables, figures, and surfaces to look at in three dimensions.

Nothing in it comes from elsewhere, and nothing that comes from data is markup: the template escapes every text, and a
content security policy lets the browser run the page's own script and style alone, which it knows by their hashes.
"""

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from greenough.instrument.files import atomic_path, make_folder

from .figures import Panel
from .surface_view import SurfaceView, palettes, payload
from .tables import Table


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels beside each other above one caption."""

    panels: Sequence[Panel]
    caption: str


@dataclass(frozen=True, eq=False)
class Section:
    """A heading, an introduction, figures and tables, in this order."""

    title: str
    text: str = ""
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()

    @property
    def anchor(self) -> str:
        """Where the page's list of contents leads."""
        return "s-" + hashlib.sha256(self.title.encode("utf-8")).hexdigest()[:10]


@dataclass(frozen=True, eq=False)
class Lead:
    """What a page opens with: a verdict, how to read it, and one picture of what was measured."""

    table: Table | None
    text: str = ""
    figure: Figure | None = None


@dataclass(frozen=True, eq=False)
class Page:
    """A report.

    Parameters
    ----------
    title, summary : str
    sections : sequence of Section
    surfaces : sequence of SurfaceView
        For the view in three dimensions, which stands before the section ``surfaces_before``.
    alarm : bool
        Whether the summary says that something is wrong.
    surfaces_before : int
    lead : Lead, optional
        Stands before everything else.
    """

    title: str
    summary: str
    sections: Sequence[Section]
    surfaces: Sequence[SurfaceView] = field(default_factory=tuple)
    alarm: bool = False
    surfaces_before: int = 1
    lead: Lead | None = None

    @property
    def figures(self) -> list[Figure]:
        """All of them, that of the lead first."""
        first = [] if self.lead is None or self.lead.figure is None else [self.lead.figure]
        return first + [figure for section in self.sections for figure in section.figures]


def render(page: Page) -> str:
    """The page as HTML."""
    here = files("greenough.pipeline.report")
    style, script = (_text(here.joinpath(name).read_text(encoding="utf-8")) for name in ("page.css", "viewer.js"))
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(here.joinpath("page.html").read_text(encoding="utf-8"))
    return template.render(
        page=page,
        policy=f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'",
        style=Markup(style),
        script=Markup(script),
        palettes=_json(palettes(page.surfaces)),
        surfaces=[(surface.name, _json(payload(surface))) for surface in page.surfaces],
    )


def write_page(path: str | Path, page: Page, pictures: str | Path | None = None) -> None:
    """Write the page; it appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        The HTML file.
    page : Page
    pictures : str or Path, optional
        A folder, made if need be, for the panels that have a PNG, as NAME.png.

    Raises
    ------
    FileError
        Where the page, or a figure, cannot be written.
    """
    text = render(page)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if pictures is None:
        return
    folder = Path(pictures)
    make_folder(folder)
    for panel in (panel for figure in page.figures for panel in figure.panels):
        if panel.png is not None:
            with atomic_path(folder / f"{panel.name}.png") as temporary:
                temporary.write_bytes(panel.png)


def _json(value: Any) -> Markup:
    """JSON that cannot end the element that it stands in."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def _text(text: str) -> str:
    """With newlines as the browser's parser leaves them, which the hashes are of."""
    return "\n" + text.replace("\r\n", "\n")


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
