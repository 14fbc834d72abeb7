"""What the site takes from elsewhere in the repository: pages from its root, recorded
pictures, and the command line's options from its parser."""

from __future__ import annotations

import argparse
import re
import warnings
from pathlib import Path
from typing import Any

import tyro
from mkdocs.structure.files import File, Files

from v3dg.cli import COMMANDS

ROOT = Path(__file__).parent.parent
PAGES = {
    "CONTRIBUTING.md": "contributing.md",
    "STYLE.md": "style.md",
    "CHANGELOG.md": "changelog.md",
}


def on_files(files: Files, config: Any) -> Files:
    """Add pages and pictures that are not in docs/."""
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
    """Point links at where the site has things, and fill in the command line."""
    if page.file.src_uri == "command_line.md":
        markdown = markdown.replace("<!-- commands -->", "\n\n".join(map(command_text, COMMANDS)))
    home = "../" * page.file.src_uri.count("/")  # from the page to the top of the site
    for source, target in PAGES.items():
        markdown = markdown.replace(f"]({home}../{source})", f"]({home}{target})")
    return markdown.replace(f"]({home}../benchmarks/results/", f"]({home}benchmarks/results/")


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Make links of the pages that docstrings name."""
    if page.file.src_uri not in ("command_line.md", "python.md"):
        return html
    return re.sub(r"\bdocs/(\w+)\.md\b", r'<a href="\1.html">\1</a>', html)


def command_text(name: str) -> str:
    """A section on one command: what it does, and tables of its arguments and
    options."""
    with warnings.catch_warnings():
        # tyro will drop it, and nothing else tells what a parser takes; the extra
        # `docs` pins its version.
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
    """An option with its short form and its value, or an argument's name."""
    value = action.metavar if isinstance(action.metavar, str) else ""
    names = ", ".join(f"`{option}`" for option in sorted(action.option_strings, key=len))
    choices = re.fullmatch(r"\{(.*)\}", value)
    value = (
        ", ".join(f"`{choice}`" for choice in choices[1].split(",")) if choices else f"*{value}*"
    )
    return f"{names} {value if value != '**' else ''}".strip()


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|").strip()
