"""Adds parts of the repository outside of docs/ to the site: pages of its root,
recorded pictures, the tutorial from its notebook, and the options of the command line
from their parser. Also writes llms.txt, an index of the pages for programs."""

from __future__ import annotations

import argparse
import json
import re
import warnings
from pathlib import Path
from typing import Any

import tyro
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Navigation, Section
from mkdocs.structure.pages import Page

from v3dg.cli import COMMANDS

ROOT = Path(__file__).parent.parent
PAGES = {
    "CONTRIBUTING.md": "contributing.md",
    "STYLE.md": "style.md",
    "CHANGELOG.md": "changelog.md",
}


NOTEBOOK = "notebooks/tutorial.ipynb"
TUTORIAL = "tutorial.md"


def on_files(files: Files, config: Any) -> Files:
    """Add pages and pictures that are not in docs/."""
    notebook = json.loads((ROOT / "docs" / NOTEBOOK).read_text(encoding="utf-8"))
    files.append(File.generated(config, TUTORIAL, content=notebook_text(notebook)))
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        for other, target in PAGES.items():
            text = text.replace(f"]({other}", f"]({target}")
        files.append(File.generated(config, page, content=text.replace("](docs/", "](")))
    for picture in sorted((ROOT / "benchmarks" / "results").rglob("*")):
        if picture.suffix in (".png", ".jpg"):
            name = picture.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Adapt links to the paths of the site, and insert the options of commands."""
    if page.file.src_uri == "command_line.md":
        markdown = markdown.replace("<!-- commands -->", "\n\n".join(map(command_text, COMMANDS)))
    # relative path from the page to the root of the site
    home = "../" * page.file.src_uri.count("/")
    for source, target in PAGES.items():
        markdown = markdown.replace(f"]({home}../{source})", f"]({home}{target})")
    return markdown.replace(f"]({home}../benchmarks/results/", f"]({home}benchmarks/results/")


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Replace the names of pages in docstrings by links."""
    if page.file.src_uri not in ("command_line.md", "python.md"):
        return html
    return re.sub(r"\bdocs/(\w+)\.md\b", r'<a href="\1.html">\1</a>', html)


def on_page_context(
    context: dict[str, Any], page: Page, config: MkDocsConfig, nav: Navigation
) -> dict[str, Any]:
    """Write the text of a page to the folder of its HTML. When the home page is
    written, all pages have been read, so write llms.txt (llmstxt.org) then."""
    site = Path(config.site_dir)
    text = site / page.file.src_uri
    text.parent.mkdir(parents=True, exist_ok=True)
    text.write_text(page.markdown or "", encoding="utf-8")
    if page.is_homepage:
        (site / "llms.txt").write_text(llms_text(nav, config), encoding="utf-8")
    return context


def llms_text(nav: Navigation, config: MkDocsConfig) -> str:
    """Return an index of the site for programs, with a section for each section of the
    navigation and a line for each page."""
    lines = [f"# {config.site_name}", "", f"> {config.site_description}"]
    for item in nav.items:
        if isinstance(item, Section):
            lines += ["", f"## {item.title}", "", *llms_links(item)]
    return "\n".join(lines) + "\n"


def llms_links(section: Section) -> list[str]:
    """Return a line for each page of a section and of its subsections."""
    lines = []
    for item in section.children:
        if isinstance(item, Section):
            lines += llms_links(item)
        elif isinstance(item, Page):
            sentence = first_sentence(item.markdown or "")
            lines.append(f"- [{item.title}]({item.file.src_uri}): {sentence}")
    return lines


def first_sentence(markdown: str) -> str:
    """Return the first sentence of the first paragraph of prose, without markup."""
    prose = re.sub(r"^```.*?^```$|<!--.*?-->", "", markdown, flags=re.M | re.S)
    for paragraph in re.split(r"\n\s*\n", prose):
        if re.match(r"[A-Za-z*`\[]", paragraph):
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(paragraph.split()))
            return re.split(r"(?<=[.:]) (?=[A-Z])", text.replace("**", ""), maxsplit=1)[0]
    return ""


def notebook_text(notebook: dict[str, Any]) -> str:
    """Return a notebook as a page, without the outputs of its cells."""
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    link = (
        f"This page is [a notebook]({NOTEBOOK}): download it, and open it in Jupyter or "
        "upload it to a hosted notebook."
    )
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n"


def command_text(name: str) -> str:
    """Return a section on one command: its description, and tables of its arguments and
    options."""
    with warnings.catch_warnings():
        # tyro will remove this function, but nothing else lists the options of a
        # parser. The extra `docs` pins the version of tyro.
        warnings.simplefilter("ignore", DeprecationWarning)
        parser: argparse.ArgumentParser = tyro.extras.get_parser(
            COMMANDS[name][0], prog=f"v3dg {name}", config=(tyro.conf.FlagCreatePairsOff,)
        )
    lines = [f"## v3dg {name}", "", (parser.description or "").strip(), ""]
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.dest != "help"]
        if not actions:
            continue
        if group.description:
            lines += [group.description.strip(), ""]
        title = "argument" if group.title == "positional arguments" else "option"
        lines += [f"| {title} | |", "| --- | --- |"]
        lines += [f"| {_spelling(action)} | {_cell(str(action.help))} |" for action in actions]
        lines.append("")
    return "\n".join(lines)


def _spelling(action: argparse.Action) -> str:
    """Return an option with its short form and its value, or the name of an
    argument."""
    value = action.metavar if isinstance(action.metavar, str) else ""
    names = ", ".join(f"`{option}`" for option in sorted(action.option_strings, key=len))
    choices = re.fullmatch(r"\{(.*)\}", value)
    value = (
        ", ".join(f"`{choice}`" for choice in choices[1].split(",")) if choices else f"*{value}*"
    )
    return f"{names} {value if value != '**' else ''}".strip()


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|").strip()
