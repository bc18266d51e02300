"""The software and the paper are named alike wherever they are named."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

SOFTWARE, REFERENCES = CITATION.split("references:\n")


def value(key: str, text: str) -> str:
    """Of a key in YAML of one or, after ``>-``, two lines; a file of few lines is read without a library."""
    found = re.search(rf"^[ -]*{key}: (?:>-\n +)?(.+)$", text, re.MULTILINE)
    assert found, key
    return found[1]


def dois(text: str) -> set[str]:
    return set(re.findall(r"10\.\d{4,9}/[\w.()/-]*\w", text))


def test_the_software_is_that_of_the_project_file():
    assert value("version", SOFTWARE) == PROJECT["version"]
    assert value("license", SOFTWARE) == PROJECT["license"]
    assert value("title", SOFTWARE).lower() == PROJECT["name"]
    assert value("abstract", SOFTWARE) == f"{PROJECT['description']}."


def test_the_keys_that_the_format_requires_are_there():
    for key in ("cff-version", "message", "title"):
        assert value(key, SOFTWARE)
    for key in ("type", "title"):
        assert value(key, REFERENCES)
    assert value("cff-version", SOFTWARE) == "1.2.0"
    assert SOFTWARE.count("authors:\n  - name: ") == 1
    assert REFERENCES.count("authors:\n      - ") == 1


def test_the_readme_and_the_citation_name_the_same_paper():
    section = README.partition("## The paper\n")[2].partition("\n## ")[0]
    title = value("title", REFERENCES)
    assert f"*{title}*" in " ".join(section.split())
    assert dois(section) == dois(REFERENCES)


def test_the_change_log_begins_with_the_version():
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[([\d.]+)\]", changes, re.MULTILINE)[0] == PROJECT["version"]
