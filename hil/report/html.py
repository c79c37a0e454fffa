"""What all pages of reports are made of: one self-contained document, its style, pictures within it."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

BEYOND = ' class="beyond"'  # of a row or cell whose value is beyond its limit
_NAME = 12  # characters before the text of a line of a command
VIDEO_FILE = "video.mp4"  # in a run's directory

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:60rem;padding:1rem;
color:#1a1a1a;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.1rem;margin:2rem 0 0}img,video{width:100%;height:auto}
.caption{margin:0 0 .3rem;color:#555;font-size:.9rem}
.verdict{padding:.7rem 1rem;font-size:1.1rem}
.stable{background:#e3f4e4;border-left:.5rem solid #2e8b3a}
.unstable,.failed{background:#fbe5e3;border-left:.5rem solid #c0392b}
table{border-collapse:separate;border-spacing:0;margin-top:.5rem}
td,th{padding:.2rem .8rem;text-align:left;vertical-align:top;border-bottom:1px solid #ddd}
td.n{text-align:right;font-variant-numeric:tabular-nums}
tr.beyond td,td.beyond{color:#c0392b;font-weight:600}
.wide{overflow-x:auto}.wide td{white-space:nowrap}
.wide td:first-child,.wide th:first-child{position:sticky;left:0;background:#fff}
.wide td.text{white-space:normal;min-width:14rem}.wide td.name{white-space:normal;min-width:8rem}
ul,ol,pre,code{overflow-wrap:anywhere}
pre{overflow-x:auto;font-size:.8rem}
@media(max-width:40rem){.plot{overflow-x:auto}.plot img{width:44rem;max-width:none}td,th{padding:.2rem .4rem}}
@media print{details,video,.modebar{display:none!important}section,tr{break-inside:avoid}h2{break-after:avoid}
body{max-width:none;padding:0;font-size:11pt}.wide{font-size:8pt;overflow:visible}.wide td{white-space:normal}
.verdict,td.beyond,tr.beyond td{print-color-adjust:exact}}
"""


class Link(NamedTuple):
    """From one page to another. ``place``: relative to the page's directory."""

    place: str
    text: str

    def __str__(self) -> str:
        return f'<a href="{html.escape(self.place)}">{html.escape(self.text)}</a>'


def document(title: str, body: str, part_of: Link | None = None) -> str:
    """A whole page; ``body`` is HTML. ``part_of``: the page above it."""
    above = "" if part_of is None else f"<p class=caption>part of {part_of}</p>\n"
    return f"""<!doctype html><html lang=en><meta charset=utf-8>
<meta name=viewport content="width=device-width,initial-scale=1"><title>{html.escape(title)}</title>
<style>{_STYLE}</style>
{above}<h1>{html.escape(title)}</h1>
{body}"""


def picture(title: str, caption: str, png: str) -> str:
    """A heading, what is to be seen, and a picture (PNG in base64)."""
    return (
        f"<section><h2>{html.escape(title)}</h2><p class=caption>{html.escape(caption)}</p>"
        f'<div class=plot><img alt="{html.escape(title)}" src="data:image/png;base64,{png}"></div></section>'
    )


def verdict(kind: str, sentence: str, said: str | None = None) -> str:
    """The coloured line at the top: ``kind`` is stable, unstable or failed; ``said``: what is written instead of it."""
    return f'<p class="verdict {kind}"><b>{html.escape(said or kind)}</b>: {html.escape(sentence)}</p>'


def told(lines: Iterable[str]) -> str:
    """What a command says, a table: of each line a name in twelve columns, and its text."""
    rows = (
        f"<tr><td>{html.escape(line[:_NAME].strip())}</td><td>{html.escape(line[_NAME:])}</td></tr>" for line in lines
    )
    return f"<table>{''.join(rows)}</table>"


def folded(summary: str, text: str) -> str:
    """Plain text that is shown when asked for."""
    return f"<details><summary>{html.escape(summary)}</summary>\n<pre>{html.escape(text)}</pre></details>\n"


def run_link(directory: Path, run: Path, text: str) -> str:
    """From a page in ``directory`` to the report of the run recorded in ``run``, or to its files if it has none."""
    target = run / "report.html"
    return str(Link(os.path.relpath(target if target.exists() else run, directory), text))


def film(directory: Path, run: Path | None = None) -> str:
    """The video of ``run`` (default: the page's own ``directory``) with its controls; nothing if there is none."""
    video = (run or directory) / VIDEO_FILE
    if not video.exists():
        return ""
    return f'<video controls preload=metadata src="{html.escape(os.path.relpath(video, directory))}"></video>'
