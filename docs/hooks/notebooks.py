"""Notebooks are Python files (jupytext's percent format): notebooks/NAME.py becomes the page notebooks/NAME.md."""

from __future__ import annotations

from pathlib import Path

import jupytext
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add a page for every notebook, with a link to its file."""
    for notebook in sorted(Path(config.docs_dir, "notebooks").glob("*.py")):
        page = jupytext.writes(jupytext.read(notebook, fmt="py:percent"), fmt="md")
        title, _, body = page.partition("\n")
        note = f"*Open [{notebook.name}]({notebook.name}) in Jupyter, with jupytext, and run it to see the pictures.*"
        text = f"{title}\n\n{note}\n{body}"
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=text))
    return files
