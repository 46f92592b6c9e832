"""Pages that the site has beside those of this folder, and Markdown as repository hosts read it.

README, CONTRIBUTING and CHANGELOG become pages. The options of both programs, and the sensors, rigs,
settings, stages and defences that come with them, are written as the programs list them: never out of date.
The guide's page of a command ends with a link to its options.
"""

from __future__ import annotations

import contextlib
import io
import re
from importlib import import_module
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]

_OF_ROOT = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages of the site that are files of the repository's root."""

_LISTS = ("rigs", "sensors", "settings", "stages", "defences")
"""Commands of `lidar` that list choices."""

_LIST_ITEM = re.compile(r"\s*([-*]|\d+\.)\s")
_TAB = 4
"""Spaces by which Markdown is indented here; repository hosts take fewer."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    pages = {name: _of_root((ROOT / source).read_text("utf-8")) for source, name in _OF_ROOT.items()}
    pages |= {f"reference/{program}.md": options_page(program) for program in ("geoscene", "lidar")}
    pages["reference/choices.md"] = choices_page()
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """The page as repository hosts read it, with a link to the options of its command."""
    command = re.fullmatch(r"guide/(geoscene|lidar)-(\w+)\.md", page.file.src_uri)
    if command and command[2] in import_module(f"{command[1]}.cli").app:
        program, name = command.groups()
        markdown += f"\nAll options: [`{program} {name}`](../reference/{program}.md#{program}-{name}).\n"
    return as_hosts_read(markdown)


def as_hosts_read(markdown: str) -> str:
    """Markdown in which lists need no blank line before them and less indentation."""
    lines: list[str] = []
    shift, fenced = 0, False
    for line in markdown.split("\n"):
        indent, text = len(line) - len(line.lstrip(" ")), line.strip()
        if text.startswith("```"):
            fenced = not fenced
            if fenced:
                shift = -indent % _TAB
            lines.append(" " * shift + line)
        elif fenced:
            lines.append(" " * shift + line if text else line)
        else:
            before = lines[-1].strip() if lines else ""
            table = text.startswith("|") and not before.startswith("|")
            if before and (table or (_LIST_ITEM.match(line) and not _in_list(lines))):
                lines.append("")
            lines.append(" " * (indent + -indent % _TAB) + text if text and indent < _TAB else line)
    return "\n".join(lines)


def _in_list(lines: list[str]) -> bool:
    """Whether the paragraph that the last line is of belongs to a list."""
    for line in reversed(lines):
        if not line.strip():
            return False
        if _LIST_ITEM.match(line):
            return True
    return False


def _of_root(text: str) -> str:
    """A page of the repository's root as one of the site: links lead from the folder of the documentation."""
    text = re.sub(r"\]\(docs/", "](", text)
    for source, name in _OF_ROOT.items():
        text = text.replace(f"]({source}", f"]({name}")
    return text


def options_page(program: str) -> str:
    """The commands of a program with all options, from its help."""
    app = import_module(f"{program}.cli").app
    text = app.generate_docs(output_format="markdown")
    for section in ("Table of Contents", f"{program} --install-completion"):
        text = re.sub(rf"\n## {section}\n.*?(?=\n## |\n\*\*Commands|\Z)", "\n", text, flags=re.DOTALL)
    text = re.sub(r"\n\* \[`--install-completion`\][^\n]*", "", text)
    commands = "|".join(name for name in app if not name.startswith("-"))
    text = re.sub(r"\n {4,}(?=\S)", " ", text.partition("\n")[2])
    text = re.sub(rf"(?<=\n\n)((?:geoscene|lidar) (?:{commands}) .*[^.])(?=\n\n)", r"```\n\1\n```", text)
    return f"# Options of `{program}`\n" + text.replace("\n```\n\n```\n", "\n")


def choices_page() -> str:
    """What the commands print that list the choices."""
    app = import_module("lidar.cli").app
    parts = ["# Built-in sensors, rigs and settings\n"]
    for name in _LISTS:
        parts += [f"## {name.capitalize()}\n", f"As `lidar {name}` lists them:\n"]
        parts += ["```text", _printed(app, name), "```\n"]
    return "\n".join(parts)


def _printed(app: Any, command: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        app([command], result_action="return_value")
    return out.getvalue().rstrip()
