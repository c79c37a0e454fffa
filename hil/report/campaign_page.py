"""The report of a campaign: one page, and JUnit's XML for what collects test results."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from hil.report.html import document, film, folded, run_link, verdict

if TYPE_CHECKING:
    from hil.lab.campaign import Result
    from hil.lab.campaign_file import Campaign

_SAID = {"passed": "as expected", "weak": "known weakness", "failed": "not as expected"}


def write_page(
    path: Path, campaign: Campaign, results: Sequence[Result], source: str, versions: Mapping[str, str]
) -> None:
    """Write the page to ``path``; the records of runs are linked from there. ``source``: the campaign's file."""
    failed = [result for result in results if result.status == "failed"]
    weak = sum(result.status == "weak" for result in results)
    sentence = f"{len(results)} trials, {len(failed)} not as expected, {weak} known weaknesses"
    rows = "".join(_row(path.parent, result) for result in sorted(results, key=_order))
    about = ", ".join(f"{name} {version}" for name, version in versions.items())
    body = (
        f"<p>{html.escape(campaign.description)}</p>"
        + verdict(*(("failed", sentence, "not as expected") if failed else ("stable", sentence, "as expected")))
        + "<h2>Trials</h2><div class=wide><table><tr><th>what is wrong<th>seed<th>expected<th>came out<th>seen</tr>"
        + f"{rows}</table></div>"
        + _films(path.parent, results)
        + folded("The campaign's file", source)
        + folded("Versions", about)
    )
    path.write_text(document(f"Campaign {campaign.name}", body), encoding="utf-8")


def _order(result: Result) -> int:
    return ("failed", "weak", "passed").index(result.status)


def _row(directory: Path, result: Result) -> str:
    seen = html.escape(result.sentence)
    if result.record is not None:
        seen = run_link(directory, result.record, result.sentence)
    if result.weakness:
        seen += f"<br><i>{html.escape(result.weakness)}</i>"
    kind = " class=beyond" if result.status == "failed" else ""
    return (
        f"<tr{kind}><td class=name>{html.escape(result.name)}</td><td class=n>{result.seed}</td>"
        f"<td class=text>{html.escape(result.expectation)}</td><td>{_SAID[result.status]}</td>"
        f"<td class=text>{seen}</td></tr>"
    )


def _films(directory: Path, results: Sequence[Result]) -> str:
    """The videos that there are."""
    kept = [(result, film(directory, result.record)) for result in results if result.record is not None]
    items = "".join(
        f"<section><p>{html.escape(f'{result.name}, seed {result.seed}: {result.sentence}')}</p>{video}</section>"
        for result, video in kept
        if video
    )
    return f"<h2>Videos</h2>{items}" if items else ""


def write_junit(path: Path, campaign: Campaign, results: Sequence[Result]) -> None:
    """Write JUnit's XML as pytest does (``xunit2``): a known weakness is skipped, as an expected failure is."""
    counts = {status: sum(result.status == status for result in results) for status in _SAID}
    elapsed = sum(result.elapsed for result in results)
    root = ElementTree.Element("testsuites")
    suite = ElementTree.SubElement(
        root, "testsuite", name=f"hil campaign {campaign.name}", tests=str(len(results)), errors="0",
        failures=str(counts["failed"]), skipped=str(counts["weak"]), time=f"{elapsed:.3f}",
    )  # fmt: skip
    for result in results:
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"campaign.{campaign.name}", name=f"{result.name}[seed{result.seed}]",
            time=f"{result.elapsed:.3f}",
        )  # fmt: skip
        text = f"expected: {result.expectation}; seen: {result.sentence}"
        if result.record is not None:
            text += f"; record: {result.record}"
        if result.status == "failed":
            ElementTree.SubElement(case, "failure", message=result.sentence).text = text
        elif result.status == "weak":
            weak = ElementTree.SubElement(case, "skipped", type="known_weakness", message=result.weakness)
            weak.text = text
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
