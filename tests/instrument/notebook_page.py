"""Reads what a result shows of itself: by an HTML parser, and pictures by a decoder of their own."""

import base64
import io
from html.parser import HTMLParser

import numpy as np
from PIL import Image

TAGS = {"div", "strong", "img", "table", "tr", "th", "td"}
ATTRIBUTES = {"src", "alt", "width", "style"}

MARKUP = "<script>alert(1)</script>\"'&lt;<img src=x onerror=alert(2)>"
"""Planted where data is shown: it must come out as text, character by character."""


class Page(HTMLParser):
    """The texts, cells and pictures of a page; it refuses tags and attributes that no result has."""

    def __init__(self, html: str):
        super().__init__()
        self.texts: list[str] = []
        self.rows: list[list[str]] = []
        self.pictures: list[np.ndarray] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open, "every tag is closed"

    @property
    def facts(self) -> dict[str, str]:
        """The rows of two cells."""
        return dict(row for row in self.rows if len(row) == 2)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        assert tag in TAGS
        assert set(given) <= ATTRIBUTES
        if tag == "img":
            kind, _, data = given["src"].partition(",")
            assert kind == "data:image/png;base64"
            with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as picture:
                assert picture.format == "PNG"
                self.pictures.append(np.asarray(picture.convert("RGB")))
            assert 200 <= int(given["width"]) <= 900
            return
        self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if self._open and self._open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
