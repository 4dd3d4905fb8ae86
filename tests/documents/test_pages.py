"""Files, names, links, sources, imports and numbers on the pages exist."""

import re
from pathlib import Path

import pytest
from documents.pages import ARCHITECTURE, MATHEMATICS, PLUGIN, ROOT, quoted, rows_below, without_blocks
from mitsuba_subdivision.evaluation.patch_tree import irregular_patch, regular_signature
from mitsuba_subdivision.mesh.signature import Fan, Signature
from mitsuba_subdivision.schemes import scheme_named

PACKAGE = PLUGIN / "mitsuba_subdivision"
# Paths on the two pages that begin with one of these lie below the top level, all others in the package.
TOP = ("tests/", "scenes/", "renders/", "plugin/", "pyproject.toml")
SUFFIXES = (".py", ".md", ".toml", ".obj", ".xml", ".json", ".cff")
# Stands for a name of the reader's own.
PLACEHOLDER = "NAME"
SOURCES = [*sorted((ROOT / "plugin").rglob("*.py")), *sorted((ROOT / "tests").rglob("*.py"))]
PAGES = sorted(ROOT.glob("*.md"))
PAGES += sorted(path for folder in (".github", "plugin", "scenes") for path in (ROOT / folder).rglob("*.md"))
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
BOTH = pytest.mark.parametrize("page", [ARCHITECTURE, MATHEMATICS], ids=lambda page: page.name)
# "[Author year]", "[Author and Author year, section]", "[.. year; .. year]"; brackets may be broken over lines.
YEAR = r"(?:19|20)\d\d[a-z]?\b"
KEY = re.compile(rf"[A-Z][\w.-]+(?: [\w.-]+)* {YEAR}")
CITATION = re.compile(rf"\[({KEY.pattern}[^\[\]]*)\]")


def text_of(page):
    return without_blocks(page.read_text(encoding="utf-8"))


def is_path(word):
    return " " not in word and PLACEHOLDER not in word and ("/" in word or word.endswith(SUFFIXES))


def citations(text):
    """Keys of the sources that a text cites."""
    flat = re.sub(r"\s*\n\s*#?\s*", " ", text)
    keys = (KEY.match(part.strip()) for citation in CITATION.findall(flat) for part in citation.split(";"))
    return {key.group() for key in keys if key}


@BOTH
def test_every_file_that_a_page_names_exists(page):
    paths = {word for word in quoted(text_of(page)) if is_path(word)}
    assert len(paths) > 20
    assert [word for word in sorted(paths) if not ((ROOT if word.startswith(TOP) else PACKAGE) / word).exists()] == []


@BOTH
def test_every_name_that_a_page_gives_is_in_the_code(page):
    words = {word for path in SOURCES for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))}
    words |= {path.stem for path in SOURCES} | {path.name for path in PACKAGE.iterdir()}
    names = {word for word in quoted(text_of(page)) if re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", word)}
    names = {name for name in names if not is_path(name) and PLACEHOLDER not in name}
    assert len(names) > 5
    assert [name for name in sorted(names) if name.split(".")[-1] not in words] == []


@EVERY_PAGE
def test_every_relative_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        assert other.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", text_of(other), flags=re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in anchors, target


def test_code_cites_pages_that_exist():
    cited = {(path, word) for path in SOURCES for word in re.findall(r"[\w/]+\.md\b", path.read_text(encoding="utf-8"))}
    names = {page.name for page in PAGES}
    # Tests of pages may name pages that are not there.
    missing = {word for path, word in cited if path.parent != Path(__file__).parent and Path(word).name not in names}
    assert missing == set()


def test_every_source_that_is_cited_is_in_the_bibliography():
    cited = {key for path in SOURCES if path != Path(__file__) for key in citations(path.read_text(encoding="utf-8"))}
    assert cited >= {"Catmull and Clark 1978", "Doo and Sabin 1978", "Loop 1987", "DeRose et al. 1998"}
    body = text_of(MATHEMATICS).partition("## 16. Bibliography")[0]
    on_pages = citations(body) | {key for page in PAGES if page != MATHEMATICS for key in citations(text_of(page))}
    assert cited | on_pages == {*re.findall(r"^- \*\*\[(.+?)\]\*\*", text_of(MATHEMATICS), flags=re.MULTILINE)}


def test_the_table_of_eigenvalues_follows_the_rules():
    rows = rows_below(MATHEMATICS, "eigenvalues")
    assert {row[0] for row in rows} == {"catmull_clark", "loop", "doo_sabin"}
    for name, cell, *stated in rows:
        scheme, valence = scheme_named(name), int(cell)
        first, *others = regular_signature(scheme).fans
        is_face = scheme.element == "face"
        fan = Fan((scheme.regular_face_size,) * valence if is_face else (valence, *first.ahead[1:]))
        basis = irregular_patch(scheme, Signature(scheme.element, (fan, *others))).basis
        second, fourth = basis.subdominant, basis.moduli[3]
        assert stated == [f"{value:.4f}" for value in (second, fourth / second, fourth / second**2)], (name, valence)


@EVERY_PAGE
def test_formulas_survive_markdown(page):
    """GitHub reads Markdown's own signs in formulas, too: no escapes of punctuation, no emphasis."""
    text = re.sub(r"`[^`\n]*`", "", text_of(page))
    displayed = re.findall(r"\$\$(.+?)\$\$", text, flags=re.DOTALL)
    rest = re.sub(r"\$\$.+?\$\$", "", text, flags=re.DOTALL)
    for formula in [*displayed, *re.findall(r"\$([^$]+)\$", rest)]:
        assert formula == formula.strip(), formula
        assert "\n" not in formula, formula
        assert not re.search(r"\\[^A-Za-z]|[*`|]|[})\]]_\w", formula), formula
        assert formula.count("{") == formula.count("}"), formula
    assert "$" not in re.sub(r"\$[^$]+\$", "", rest)
