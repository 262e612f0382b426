"""What the pages of `make docs` have besides the Markdown in this folder; `mkdocs.yml` names this file.

Pages that lie elsewhere in the repository, links to them, tables of all settings, formulas, and the check that no page
asks another machine for anything.
"""

import inspect
import posixpath
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from toolkit.manifest import STAGES, Manifest
from toolkit.manifest.settings import Settings, nested_model

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = {
    "benchmarks.md": "benchmarks/README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
"""Pages of the site whose files are not in docs/: where the site has them, where the repository."""
DRAWER = {"76.25em": "68.75em", "76.234375em": "68.734375em"}
"""The width below which the theme folds its navigation away, 1,220 px, and what it becomes, 1,100 px."""
OPTION = re.compile(r"(?<![\w-])--?[a-zA-Z][\w-]*(?![^<]*>)")
"""An option in the HTML of code, but nothing in its tags."""
PART = re.compile(r"(?<=[\w;][/._=:,])(?=[a-zA-Z])(?![^<]*>)")
"""Where the next part of a path or name begins in the HTML of code, but nothing in its tags."""
SETTINGS = "<!-- all settings -->"
"""What the tables of all settings take the place of."""
END = "...\n"  # of a YAML document that is a plain value
FOLLOWED = {"canonical", "next", "prev", "alternate", "license"}
"""Kinds of `link` that a browser does not fetch."""
FETCHING = {"img": "src", "script": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src"}
FETCHING |= {"embed": "src", "object": "data", "image": "href", "use": "href"}
"""Elements that a browser fetches something for, and the attribute that says what; `link` depends on its `rel`."""


def on_config(config: "MkDocsConfig") -> None:
    """Draw code blocks called `math` as MathML, which browsers show without a script."""
    fence = {"name": "math", "class": "math", "format": formula}
    config.mdx_configs.setdefault("pymdownx.superfences", {})["custom_fences"] = [fence]


def on_files(files: "Files", config: "MkDocsConfig") -> None:
    """Add the pages from elsewhere."""
    from mkdocs.structure.files import File

    for name, source in ELSEWHERE.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text()))


def on_page_markdown(markdown: str, page: "Page", **_: Any) -> str:
    """Mend links that lead out of docs/, and put the settings where they belong.

    The site's Markdown wants an empty line before a list, which GitHub's does not, and knows no second word after the
    language of a code block, which is for the tests.
    """
    name = page.file.src_uri
    text = re.sub(r"\[([^]]*)\]\(([^)\s]+)\)", lambda found: site_link(name, found[1], found[2]), markdown)
    text = re.sub(r"^(```\w+) \w+$", r"\1", text, flags=re.MULTILINE)
    text = "".join(part if part.startswith("```") else apart(part) for part in re.split(r"(?ms)(^```.*?^```$)", text))
    return text.replace(SETTINGS, "\n".join(settings_tables())) if SETTINGS in text else text


def on_page_content(html: str, **_: Any) -> str:
    """Keep options such as `--hold-out` in one line; browsers would break it after each hyphen.

    In cells of tables, long names may be broken after a slash, a dot or an underscore, where site.css allows it.
    """
    kept = r'<span class="option">\g<0></span>'
    text = re.sub(r"(?s)<code>.*?</code>", lambda found: OPTION.sub(kept, found[0]), html)
    return re.sub(r"<code>[^\n]*?</code>(?=(?:(?!<td)[^\n])*</td>)", lambda found: PART.sub("<wbr>", found[0]), text)


def on_post_build(config: "MkDocsConfig") -> None:
    """Show the navigation on screens of 1,200 px, and refuse a site that needs other machines.

    Raises:
        PluginError: names the pages and what they would fetch; or the theme has no such width.
    """
    from mkdocs.exceptions import PluginError

    site = Path(config.site_dir)
    styles = [*site.glob("assets/stylesheets/main.*.css"), *site.glob("assets/stylesheets/palette.*.css")]
    for file in [*styles, *site.glob("assets/javascripts/bundle.*.js")]:
        text = file.read_text()
        if "76.25em" not in text:
            raise PluginError(f"{file.name} of the theme knows no width of 76.25em: mend DRAWER in docs/site_hooks.py.")
        file.write_text(re.sub("|".join(map(re.escape, DRAWER)), lambda found: DRAWER[found[0]], text))
    asked = [
        f"{file.relative_to(site)}: {address}"
        for file in sorted(site.rglob("*"))
        if file.suffix in (".html", ".css", ".svg")
        for address in fetched_from_elsewhere(file.read_text())
    ]
    if asked:
        raise PluginError("Pages fetch from other machines; put a copy in docs/assets:\n" + "\n".join(asked))


def site_link(name: str, text: str, link: str) -> str:
    """Return a Markdown link of the page `name` as the site needs it; only its text, where the site has no such page.

    A file of the repository that is neither in docs/ nor in `ELSEWHERE` has no page.
    """
    target, mark, anchor = link.partition("#")
    if not target or re.match(r"[a-z]+:", target):
        return f"[{text}]({link})"
    source = ELSEWHERE.get(name, f"docs/{name}")
    path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
    pages = {place: page for page, place in ELSEWHERE.items()} | {"README.md": "index.md"}
    place = pages.get(path, path.removeprefix("docs/") if path.startswith("docs/") else "")
    if not place:
        return text
    return f"[{text}]({posixpath.relpath(place, posixpath.dirname(name) or '.')}{mark}{anchor})"


def apart(text: str) -> str:
    """Return Markdown, without blocks of code, with an empty line between a paragraph and a list after it."""
    return re.sub(r"^((?![-\d|#\s]).+)\n(?=(?:1\.|-) )", r"\1\n\n", text, flags=re.MULTILINE)


def formula(source: str, *_: Any, **__: Any) -> str:
    """Return MathML of a formula in LaTeX."""
    from latex2mathml.converter import convert

    return f'<div class="formula">{convert(source.strip(), display="block")}</div>'


def settings_tables() -> Iterator[str]:
    """Yield Markdown of all settings: a heading and a table for each section of the manifest's tree."""
    yield from _tables("Manifest", Manifest, "", leave_out=STAGES)
    for stage in STAGES:
        yield from _tables(f"`{stage}`", type(Manifest.defaults(stage)), f"{stage}.")


def _tables(title: str, model: type[Settings], prefix: str, leave_out: tuple[str, ...] = ()) -> Iterator[str]:
    about = inspect.cleandoc(model.__doc__ or "")
    level = "##" if prefix.count(".") < 2 else "###"
    yield from (f"\n{level} {title}\n", f"{about}\n", "| setting | default | what |", "|---|---|---|")
    inner = []
    for name, field in model.model_fields.items():
        if name in leave_out:
            continue
        section = nested_model(field.annotation)
        is_section = section is not None and issubclass(section, Settings)
        if is_section:
            inner.append((name, section))
        if field.is_required():
            default = "" if model is Manifest else "has to be given"
        elif isinstance(field.get_default(), Settings):
            default = "see below"
        elif is_section and field.get_default() is None:
            default = "off"
        else:
            default = yaml.safe_dump(field.get_default(), default_flow_style=True, width=1000)
            default = f"`{default.removesuffix(END).strip()}`"
        meaning = " ".join((field.description or "").split()).replace("|", "\\|")
        meaning = re.sub(r"`[^`]*`|<", lambda found: "&lt;" if found[0] == "<" else found[0], meaning)
        yield f"| `{prefix}{name}` | {default} | {meaning} |"
    for name, section in inner:
        yield from _tables(f"`{prefix}{name}`", section, f"{prefix}{name}.")


def fetched_from_elsewhere(text: str) -> list[str]:
    """Return what a browser that opens a page, a style sheet or a drawing would fetch from other machines.

    Links that a reader may follow are not meant.
    """
    finder = _Finder()
    finder.feed(text)
    addresses = finder.found + re.findall(r"(?:url\(\s*|@import\s)['\"]?([^'\")]+)", text)
    return [address for address in addresses if re.match(r"(https?:)?//", address.strip())]


class _Finder(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name.removeprefix("xlink:"): value or "" for name, value in attrs}
        if tag == "link" and not FOLLOWED & {*values.get("rel", "").split()}:
            self.found.append(values.get("href", ""))
        if tag in FETCHING:
            self.found.append(values.get(FETCHING[tag], ""))
            self.found += [part.split()[0] for part in values.get("srcset", "").split(",") if part.strip()]
