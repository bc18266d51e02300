"""Links between the documents of the project lead somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_linked_files_and_sections_exist(page: Path):
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text(encoding="utf-8")):
        name, _, section = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), link
        if section:
            assert section in (definitions(target) if target.suffix == ".py" else anchors(target)), link


def test_pages_link_to_each_other():
    """A page without links would pass the test above whatever the pattern finds."""
    links = [re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text(encoding="utf-8")) for page in PAGES]
    assert sum(map(len, links)) > 20


def definitions(module: Path) -> set[str]:
    return set(re.findall(r"^def (\w+)", module.read_text(encoding="utf-8"), re.MULTILINE))


def anchors(page: Path) -> set[str]:
    """As the usual renderers make them of headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
