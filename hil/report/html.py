"""What all pages of reports are made of: one self-contained document, its style, pictures within it."""

from __future__ import annotations

import html

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;max-width:60rem;padding:1rem;
color:#1a1a1a;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.1rem;margin:2rem 0 0}img{width:100%;height:auto}
.caption{margin:0 0 .3rem;color:#555;font-size:.9rem}
.verdict{padding:.7rem 1rem;font-size:1.1rem}
.stable{background:#e3f4e4;border-left:.5rem solid #2e8b3a}
.unstable,.failed{background:#fbe5e3;border-left:.5rem solid #c0392b}
table{border-collapse:collapse;margin-top:.5rem}
td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #ddd}
td.n{text-align:right;font-variant-numeric:tabular-nums}
tr.beyond td{color:#c0392b;font-weight:600}
.wide{overflow-x:auto}.wide td{white-space:nowrap}
pre{overflow-x:auto;font-size:.8rem}
@media print{details{display:none}img{break-inside:avoid}}
"""


def document(title: str, body: str) -> str:
    """A whole page; ``body`` is HTML."""
    return f"""<!doctype html><html lang=en><meta charset=utf-8>
<meta name=viewport content="width=device-width,initial-scale=1"><title>{html.escape(title)}</title>
<style>{_STYLE}</style>
<h1>{html.escape(title)}</h1>
{body}"""


def picture(title: str, caption: str, png: str) -> str:
    """A heading, what is to be seen, and a picture (PNG in base64)."""
    return (
        f"<h2>{html.escape(title)}</h2><p class=caption>{html.escape(caption)}</p>"
        f'<img alt="{html.escape(title)}" src="data:image/png;base64,{png}">'
    )


def verdict(kind: str, sentence: str) -> str:
    """The coloured line at the top: ``kind`` is stable, unstable or failed."""
    return f'<p class="verdict {kind}"><b>{kind}</b>: {html.escape(sentence)}</p>'


def folded(summary: str, text: str) -> str:
    """Plain text that is shown when asked for."""
    return f"<details><summary>{html.escape(summary)}</summary>\n<pre>{html.escape(text)}</pre></details>\n"
